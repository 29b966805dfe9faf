"""Planes that an earlier stack shows already: a drawing that is sent twice knows no more than one."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from model.geometry import Grid
from model.inference.mask_stack import MaskStack, Plane, box_corners, index_box

#: Planes of one place are parallel to within this sine, as thick and no farther apart than this share of that.
SAME_DIRECTION, SAME_PLACE = 0.01, 0.1


def each_place_once(
    stacks: Sequence[MaskStack], planes: Sequence[Plane]
) -> tuple[tuple[Plane, ...], tuple[Plane, ...]]:
    """The planes without those of which an earlier stack shows all that was looked at, and those.

    Planes show the same where they lie in the same place and are as thick.
    """
    if len({plane.stack for plane in planes}) < 2:
        return tuple(planes), ()
    grids = [stacks[plane.stack].grid for plane in planes]
    number = np.array([plane.stack for plane in planes])
    across = np.stack([grid.directions[:, plane.axis] for grid, plane in zip(grids, planes, strict=True)])
    thick = np.array([grid.spacing[plane.axis] for grid, plane in zip(grids, planes, strict=True)])
    boxes = np.stack([looked_at(stacks[plane.stack], plane) for plane in planes])
    middle = boxes.mean(axis=1)

    def is_repeat(one: int) -> bool:
        same = number < number[one]
        same &= np.linalg.norm(np.cross(across, across[one]), axis=1) < SAME_DIRECTION
        same &= np.abs((middle - middle[one]) @ across[one]) < SAME_PLACE * thick[one]
        same &= np.abs(thick - thick[one]) < SAME_PLACE * thick[one]
        return any(_holds(grids[other], boxes[other], boxes[one]) for other in np.flatnonzero(same).tolist())

    is_again = [is_repeat(one) for one in range(len(planes))]
    first = (plane for plane, again in zip(planes, is_again, strict=True) if not again)
    return tuple(first), tuple(plane for plane, again in zip(planes, is_again, strict=True) if again)


def _holds(grid: Grid, first: Float[np.ndarray, "8 3"], second: Float[np.ndarray, "8 3"]) -> bool:
    """Whether a box along the axes of a grid holds other corners (world mm), to half a voxel."""
    box, corners = grid.to_index(first), grid.to_index(second)
    return bool((corners >= box.min(axis=0) - 0.5).all() and (corners <= box.max(axis=0) + 0.5).all())


def looked_at(stack: MaskStack, plane: Plane) -> Float[np.ndarray, "8 3"]:
    """World corners of the box around the voxels of a plane that were looked at."""
    low, high = index_box(~np.take(stack.excluded, [plane.index], axis=plane.axis))
    low[plane.axis] = high[plane.axis] = plane.index
    return stack.grid.to_world(box_corners(low, high))
