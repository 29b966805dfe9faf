"""Learned modes with the settings of their fit, as files."""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from training.baselines.distance_fit import FitSettings
from training.baselines.distance_modes import DistanceModes


@dataclass(frozen=True)
class ChosenModes:
    """Modes, reduced to those in use, and the settings of their fit."""

    modes: DistanceModes
    settings: FitSettings


def write_chosen(chosen: ChosenModes, path: Path) -> None:
    """Write the modes to ``path`` (``.npz``) and the settings beside it (``.json``), the settings last."""
    chosen.modes.save(path)
    path.with_suffix(".json").write_text(json.dumps(asdict(chosen.settings)) + "\n", encoding="utf-8")


def is_kept(path: Path) -> bool:
    """Whether `write_chosen` has finished there."""
    return path.is_file() and path.with_suffix(".json").is_file()


def read_chosen(path: Path) -> ChosenModes:
    """What `write_chosen` wrote."""
    settings = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    return ChosenModes(DistanceModes.load(path), FitSettings(**settings))


def digest_of(path: Path) -> str:
    """SHA-256 of modes and settings."""
    parts = path.read_bytes() + path.with_suffix(".json").read_bytes()
    return hashlib.sha256(parts).hexdigest()
