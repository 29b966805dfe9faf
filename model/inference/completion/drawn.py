"""What was drawn of a lattice's voxels."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from model.inference.mask_stack import MaskStack, Plane


def drawn_at(
    world: Float[np.ndarray, "n 3"], reach_mm: float, stacks: Sequence[MaskStack], planes: Sequence[Plane]
) -> Bool[np.ndarray, "2 n"]:
    """Which points lie on a drawn plane, inside what was drawn there (first row) or outside (second).

    Of several planes the nearest one counts.

    Args:
        world: points (RAS mm).
        reach_mm: points this near to a plane lie on it: half a step of their lattice.
        stacks: the drawing.
        planes: those that count.
    """
    nearest, label = np.full(len(world), np.inf), np.zeros(len(world), bool)
    for plane in planes:
        stack = stacks[plane.stack]
        across = np.linalg.inv(stack.grid.affine)[plane.axis]
        gap = np.abs(world @ across[:3] + across[3] - plane.index) / np.linalg.norm(across[:3])
        rows = np.flatnonzero(gap <= np.minimum(reach_mm, nearest))
        voxels = np.rint(stack.grid.to_index(world[rows])).astype(int)
        voxels[:, plane.axis] = plane.index
        within = ((voxels >= 0) & (voxels < np.array(stack.grid.shape))).all(axis=1)
        rows, at = rows[within], tuple(voxels[within].T)
        seen = ~stack.excluded[at]
        rows, inside = rows[seen], stack.foreground[at][seen]
        # Of planes that are equally near the order does not matter.
        label[rows] = inside | (label[rows] & (gap[rows] == nearest[rows]))
        nearest[rows] = gap[rows]
    drawn = np.isfinite(nearest)
    return np.stack([drawn & label, drawn & ~label])
