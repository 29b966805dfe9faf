"""Modes of shape to their wire types."""

from dataclasses import asdict

from model.bundle import ShapeModel
from model.inference.modes import ShapeModes
from service.mode_schemas import ActiveModes, ModeList, ModeSchema
from service.schemas import ModelReference


def mode_list(model: ShapeModel, modes: ShapeModes, address: str) -> ModeList:
    """The wire form of a model's modes, which stand at an address."""
    manifest = model.manifest
    low, middle, high = modes.active()
    return ModeList(
        model=ModelReference(name=manifest.name, version=manifest.version, digest=model.digest),
        active_dimensions=ActiveModes(percent_95=low, percent_97=middle, percent_99=high),
        modes=[ModeSchema(**asdict(mode), link=f"{address}/{mode.rank}") for mode in modes.ranked],
    )
