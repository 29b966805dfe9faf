"""What to tell of a result beside the model's own warnings: how it fits the grid and step it is given back on."""

import numpy as np
from jaxtyping import Float

from model.geometry import Grid
from model.inference.mesh import Mesh, volume_ml

#: From a voxel's centre to its border (voxels).
HALF = 0.5
#: How far the surface may leave a grid's outermost voxels before maps on it count as cut (voxels).
CUT_VOXELS = 1.0
#: A mesh whose volume differs from the figure by more than this share of it is coarse.
COARSE_SHARE = 0.02


def grid_cautions(mesh: Mesh, grid: Grid) -> tuple[str, ...]:
    """What to tell when maps on the grid of the first mask do not show the whole body."""
    beyond = _beyond(mesh, grid)
    if (beyond <= CUT_VOXELS).all():
        return ()
    reach_mm = float((beyond * grid.spacing).max())
    percent = min(99, int(100 * share_within(mesh, grid)))
    sentence = (
        f"The surface reaches up to {reach_mm:.1f} mm beyond the grid of the first mask; maps on that grid show "
        f"{percent} % of the body, those at a spacing_mm all of it."
    )
    return (sentence,)


def coarse_cautions(mesh: Mesh, step_mm: float | None, figure_ml: float, judged_mm: float) -> tuple[str, ...]:
    """What to tell when the mesh at a step that was asked for does not enclose the volume that is told.

    Args:
        step_mm: of the mesh; None where none was asked for.
        figure_ml: the volume that is told.
        judged_mm: step of the surface that figures are taken from.
    """
    enclosed = volume_ml(mesh)
    if step_mm is None or step_mm <= judged_mm or abs(enclosed - figure_ml) <= COARSE_SHARE * figure_ml:
        return ()
    return (f"The mesh at {step_mm:g} mm encloses {enclosed:.3g} mL; figures are measured at {judged_mm:g} mm.",)


def share_within(mesh: Mesh, grid: Grid) -> float:
    """Share of the volume of a closed mesh that lies within the voxels of a grid, 0 to 1.

    By the divergence theorem: the flux of ``clamp(z)`` along the axis that the mesh leaves farthest, through the faces
    whose middles lie within the others.
    """
    axes = np.argsort(_beyond(mesh, grid))
    corners = grid.to_index(mesh.vertices)[:, axes][mesh.faces]
    last = np.array(grid.shape)[axes] - HALF
    middle = last[2] / 2
    rises = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    centres = corners.mean(axis=1)
    held = ((centres[:, :2] >= -HALF) & (centres[:, :2] <= last[:2])).all(axis=1)
    heights = np.clip(centres[:, 2], -HALF, last[2]) - middle
    whole = float(rises @ (centres[:, 2] - middle))
    return float(np.clip(rises[held] @ heights[held] / whole, 0.0, 1.0)) if whole else 0.0


def _beyond(mesh: Mesh, grid: Grid) -> Float[np.ndarray, "3"]:
    """How far a mesh reaches beyond a grid's voxels along each index axis (voxels), 0 where it does not."""
    index = grid.to_index(mesh.vertices)
    below, above = -HALF - index.min(axis=0), index.max(axis=0) - (np.array(grid.shape) - HALF)
    return np.asarray(np.maximum(np.maximum(below, above), 0.0))
