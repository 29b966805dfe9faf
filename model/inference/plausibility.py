"""What of a drawn surface tells that no such object exists in the population."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Literal

import numpy as np

from model.bundle import ShapeModel
from model.inference.mesh import Mesh, components, volume_ml
from model.inference.surface import canonical_box

#: Why a drawn surface is rejected: there is none, it has several parts, it leaves the model's box, or its volume lies
#: outside of the population's range.
Reason = Literal["empty", "components", "border", "volume"]
#: The range of volumes reaches this share beyond the smallest and the largest of the training population.
VOLUME_MARGIN = 0.1


def implausible(model: ShapeModel, mesh: Mesh) -> Reason | None:
    """Why a surface with all of its parts is implausible, or None.

    Args:
        mesh: in the canonical frame (mm), specks kept.
    """
    if mesh.is_empty:
        return "empty"
    if components(mesh)[0] > 1:
        return "components"
    if bool(np.any(np.abs(mesh.vertices) >= canonical_box(model) - 1e-6)):
        return "border"
    low, high = volume_range_ml(model)
    return None if low <= volume_ml(mesh) <= high else "volume"


def volume_range_ml(model: ShapeModel) -> tuple[float, float]:
    """Volumes (mL) that are plausible."""
    volumes = model.population.volumes_ml
    return float(volumes.min()) * (1.0 - VOLUME_MARGIN), float(volumes.max()) * (1.0 + VOLUME_MARGIN)


def counted(rejections: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Sum of counts by reason."""
    total: Counter[str] = Counter()
    for rejection in rejections:
        total.update(rejection)
    return dict(total)
