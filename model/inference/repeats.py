"""Planes that an earlier stack shows already: a drawing that is sent twice knows no more than one."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from model.inference.mask_stack import MaskStack, Plane, box_corners, index_box

#: Planes of one place are parallel to within this sine, as thick and no farther apart than this share of that.
SAME_DIRECTION, SAME_PLACE = 0.01, 0.1


def repeats(stacks: Sequence[MaskStack], planes: Sequence[Plane]) -> set[Plane]:
    """Planes of which an earlier stack shows all that was looked at, in the same place and as thick."""
    if len({plane.stack for plane in planes}) < 2:
        return set()
    grids = [stacks[plane.stack].grid for plane in planes]
    across = np.stack([grid.directions[:, plane.axis] for grid, plane in zip(grids, planes, strict=True)])
    thick = np.array([grid.spacing[plane.axis] for grid, plane in zip(grids, planes, strict=True)])
    middle = np.stack([looked_at(stacks[plane.stack], plane).mean(axis=0) for plane in planes])
    found: set[Plane] = set()
    for number, plane in enumerate(planes):
        same = np.array([other.stack < plane.stack for other in planes])
        same &= np.linalg.norm(np.cross(across, across[number]), axis=1) < SAME_DIRECTION
        same &= np.abs((middle - middle[number]) @ across[number]) < SAME_PLACE * thick[number]
        same &= np.abs(thick - thick[number]) < SAME_PLACE * thick[number]
        if any(_holds(stacks, planes[other], plane) for other in np.flatnonzero(same).tolist()):
            found.add(plane)
    return found


def _holds(stacks: Sequence[MaskStack], first: Plane, second: Plane) -> bool:
    """Whether what was looked at on a plane lies within what was looked at on another one, to half a voxel."""
    grid, low_high = stacks[first.stack].grid, looked_at(stacks[first.stack], first)
    box, corners = grid.to_index(low_high), grid.to_index(looked_at(stacks[second.stack], second))
    return bool((corners >= box.min(axis=0) - 0.5).all() and (corners <= box.max(axis=0) + 0.5).all())


def looked_at(stack: MaskStack, plane: Plane) -> Float[np.ndarray, "8 3"]:
    """World corners of the box around the voxels of a plane that were looked at."""
    low, high = index_box(~np.take(stack.excluded, [plane.index], axis=plane.axis))
    low[plane.axis] = high[plane.axis] = plane.index
    return stack.grid.to_world(box_corners(low, high))
