"""Drawings in stacks of any orientation: on random planes cut out of dense masks.

Each plane is a stack of its own: one slice of (a, b, 1) voxels at the mask's finest spacing, with its own affine.
Normals are uniform on the sphere, offsets uniform over the object's extent along the normal; planes that miss the
object are drawn anew. A drawing of more planes holds those of a drawing of fewer.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from model.geometry import Grid
from model.inference.observations import MaskStack, Plane
from training.cohorts.cohort import Case
from training.sparsify import Drawing

#: Least area (mm^2) of a section that counts as holding the object.
LEAST_AREA_MM2 = 4.0
#: Voxels of a section are foreground from this interpolated occupancy on.
OCCUPIED = 0.5


@dataclass(frozen=True)
class SliceStacks:
    """A drawing in several stacks and its planes."""

    stacks: tuple[MaskStack, ...]
    planes: tuple[Plane, ...]


def in_one_stack(drawing: Drawing) -> SliceStacks:
    """A drawing in one stack."""
    return SliceStacks((drawing.stack,), drawing.planes)


def random_planes(case: Case, count: int, seed: int = 0) -> SliceStacks:
    """The first planes of a case: a pure function of its name, its mask and the seed."""
    rng = _stream(case.name, seed)
    world = case.grid.to_world(np.argwhere(case.mask).astype(float))
    stacks: list[MaskStack] = []
    while len(stacks) < count:
        normal = _direction(rng)
        reach = world @ normal
        offset = float(rng.uniform(reach.min(), reach.max()))
        stack = section(case, normal, offset, f"mask[{len(stacks)}]")
        area = stack.foreground.sum() * float(np.prod(stack.grid.spacing[:2]))
        if area >= LEAST_AREA_MM2:
            stacks.append(stack)
    return SliceStacks(tuple(stacks), tuple(Plane(number, 2, 0) for number in range(count)))


def section(case: Case, normal: Float[np.ndarray, "3"], offset_mm: float, part: str) -> MaskStack:
    """The section of a mask by the plane ``normal . x = offset`` (world mm), wide enough to hold the whole crop.

    Occupancy is interpolated linearly and cut at one half; voxels beyond the crop are excluded.
    """
    grid = section_grid(case.grid, normal, offset_mm)
    index = case.grid.to_index(grid.centres())
    last = np.array(case.grid.shape) - 1.0
    within = ((index >= 0.0) & (index <= last)).all(axis=1).reshape(grid.shape)
    value = map_coordinates(case.mask.astype(np.float32), index.T, order=1, mode="nearest").reshape(grid.shape)
    return MaskStack(part, grid, np.asarray((value >= OCCUPIED) & within), np.asarray(~within))


def section_grid(around: Grid, normal: Float[np.ndarray, "3"], offset_mm: float) -> Grid:
    """One slice of square voxels at the finest spacing of a grid, over the projection of the grid onto the plane."""
    step = float(around.spacing.min())
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first), normal], axis=1)
    last = np.array(around.shape) - 1.0
    corners = around.to_world(np.array(list(np.ndindex(2, 2, 2))) * last) @ axes[:, :2]
    low, high = corners.min(axis=0), corners.max(axis=0)
    a, b = (int(size) for size in np.ceil((high - low) / step) + 1)
    affine = np.eye(4)
    affine[:3, :3] = step * axes
    affine[:3, 3] = axes @ np.append(low, offset_mm)
    return Grid((a, b, 1), affine)


def _stream(name: str, seed: int) -> np.random.Generator:
    digest = hashlib.sha256(f"{seed} {name}".encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, np.uint32))


def _direction(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Uniform on the sphere."""
    drawn = rng.standard_normal(3)
    return np.asarray(drawn / np.linalg.norm(drawn))
