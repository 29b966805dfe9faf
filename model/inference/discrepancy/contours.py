"""Where the drawn contours run: points between neighbouring voxels of a plane that have different labels."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from model.inference.mask_stack import MaskStack, Plane, section_of

#: Of more points than this altogether every second, third, ... one of a plane is given, but so many of each at least.
MOST_POINTS, LEAST_OF_PLANE = 1 << 20, 1 << 10


def contour_points(
    stacks: Sequence[MaskStack], planes: Sequence[Plane]
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """World points (mm) half-way between in-plane neighbours with different labels, and the number of their plane.

    Nothing is said at the border of the grid nor beside voxels that were not looked at: a section that is cut off
    there has an open contour. Speckled masks have a contour about every voxel; of these not all points are given.
    """
    points, numbers = [np.zeros((0, 3))], [np.zeros(0, int)]
    most = max(LEAST_OF_PLANE, MOST_POINTS // max(1, len(planes)))
    for number, plane in enumerate(planes):
        stack = stacks[plane.stack]
        inside, seen = section_of(stack.foreground, plane), ~section_of(stack.excluded, plane)
        middles = np.concatenate([_middles(inside, seen, 0), _middles(inside, seen, 1)])
        middles = middles[:: max(1, -(-len(middles) // most))]
        index = np.insert(middles, plane.axis, plane.index, axis=1)
        points.append(stack.grid.to_world(index))
        numbers.append(np.full(len(index), number))
    return np.concatenate(points), np.concatenate(numbers)


def _middles(inside: Bool[np.ndarray, "a b"], seen: Bool[np.ndarray, "a b"], axis: int) -> Float[np.ndarray, "n 2"]:
    """Middles (in-plane voxel indices) of the pairs along one axis that differ."""
    first = [slice(None), slice(None)]
    second = [slice(None), slice(None)]
    first[axis], second[axis] = slice(None, -1), slice(1, None)
    a, b = tuple(first), tuple(second)
    pairs = np.argwhere((inside[a] != inside[b]) & seen[a] & seen[b]).astype(float)
    pairs[:, axis] += 0.5
    return pairs
