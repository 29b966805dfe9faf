"""Drawings in stacks of any orientation: on random planes cut out of dense masks.

Each plane is a stack of its own: one slice of (a, b, 1) voxels at the mask's finest spacing, with its own affine.
Normals are uniform on the sphere, offsets uniform over the object's extent along the normal; planes that miss the
object, or hardly touch it, are drawn anew. A drawing of more planes holds those of a drawing of fewer.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from model.errors import CohortError
from model.geometry import Grid
from model.inference.observations import MaskStack, Plane
from training.cohorts.cohort import Case
from training.placing import inner_points
from training.sparsify import Drawing, body_axes

#: Least area (mm^2) of a section that counts as holding the object; of a small object, this share of its largest axial
#: section.
LEAST_AREA_MM2, LEAST_SHARE = 4.0, 0.1
#: Planes that are tried, at most, for one that holds the object.
TRIES = 1000
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


def random_planes(case: Case, count: int, seed: int = 0, *, tries: int = TRIES) -> SliceStacks:
    """The first planes of a case: a pure function of its name, its mask and the seed.

    Raises:
        CohortError: none of so many tries for a plane holds the object; names the case.
    """
    rng = _stream(case.name, seed)
    world = inner_points(case.mask, case.grid)
    stacks = tuple(_holding(case, world, rng, tries, f"mask[{number}]") for number in range(count))
    return SliceStacks(stacks, tuple(Plane(number, 2, 0) for number in range(count)))


def _holding(case: Case, world: Float[np.ndarray, "n 3"], rng: np.random.Generator, tries: int, part: str) -> MaskStack:
    """The next random plane that holds the object, whose voxels lie at some points of the world."""
    least = least_area(case)
    for _ in range(tries):
        normal = _direction(rng)
        reach = world @ normal
        stack = section(case, normal, float(rng.uniform(reach.min(), reach.max())), part)
        if stack.foreground.sum() * float(np.prod(stack.grid.spacing[:2])) >= least:
            return stack
    raise CohortError(
        f"{case.name}: hardly any plane shows {least:.2g} mm^2 of it; an object of more voxels across is accepted."
    )


def least_area(case: Case) -> float:
    """Area (mm^2) of a section from which on it counts as holding the object."""
    axial = body_axes(case.grid)[2]
    voxels = np.moveaxis(case.mask, axial, 0).sum(axis=(1, 2)).max()
    return min(LEAST_AREA_MM2, LEAST_SHARE * float(voxels * np.delete(case.grid.spacing, axial).prod()))


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
