"""Where planes would cut a surface: points along the curves, each standing for a piece of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from model.geometry import Grid
from model.inference.discrepancy.grouping import cells_of
from model.inference.mask_stack import Plane
from model.inference.mesh import Mesh

#: Angle between two neighbours in a spiral that covers a sphere evenly.
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True)
class Cut:
    """A plane that may be drawn.

    Attributes:
        origin: a point of it, the middle of its section (world RAS mm).
        normal: unit (world RAS).
        plane: the plane of voxels, None for a free one.
    """

    origin: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    plane: Plane | None = None


@dataclass(frozen=True)
class SectionCurve:
    """The curve in which a plane cuts the surface.

    Attributes:
        points: (m, 3) world mm.
        lengths: (m,) length of the curve (mm) that each stands for.
    """

    points: Float[np.ndarray, "m 3"]
    lengths: Float[np.ndarray, "m"]


def section_curve(mesh: Mesh, cut: Cut, spacing_mm: float) -> SectionCurve:
    """Section of a closed mesh, its segments taken together in cells of about `spacing_mm`."""
    # A vertex in the plane counts as above it, so that every edge is crossed once or not at all.
    height = (mesh.vertices - cut.origin) @ cut.normal
    above = height >= 0.0
    crossed = mesh.faces[np.isin(above[mesh.faces].sum(axis=1), (1, 2))]
    if not len(crossed):
        return SectionCurve(np.zeros((0, 3)), np.zeros(0))
    corners, heights = mesh.vertices[crossed], height[crossed]
    alone = _lone_corner(heights >= 0.0)
    rows = np.arange(len(crossed))
    ends = [_between(corners, heights, rows, alone, (alone + step) % 3) for step in (1, 2)]
    lengths, middles = np.linalg.norm(ends[1] - ends[0], axis=1), 0.5 * (ends[0] + ends[1])
    cells = cells_of(middles, spacing_mm)
    total = np.bincount(cells, lengths)
    sums = np.stack([np.bincount(cells, lengths * column) for column in middles.T], axis=1)
    kept = total > 0.0
    return SectionCurve(sums[kept] / total[kept, None], total[kept])


def _lone_corner(above: np.ndarray) -> Int[np.ndarray, "f"]:
    """Number of the corner that lies alone on its side of the plane."""
    return np.asarray(np.argmax(above == (above.sum(axis=1) == 1)[:, None], axis=1))


def _between(
    corners: Float[np.ndarray, "f 3 3"],
    heights: Float[np.ndarray, "f 3"],
    rows: Int[np.ndarray, "f"],
    first: Int[np.ndarray, "f"],
    second: Int[np.ndarray, "f"],
) -> Float[np.ndarray, "f 3"]:
    a, b = heights[rows, first], heights[rows, second]
    share = (a / (a - b))[:, None]
    return np.asarray((1.0 - share) * corners[rows, first] + share * corners[rows, second])


def grid_cuts(mesh: Mesh, grid: Grid, axis: int, indices: Sequence[int]) -> list[Cut]:
    """Planes of voxels of the first stack along one axis."""
    normal = np.linalg.inv(grid.affine[:3, :3])[axis]
    normal = normal / np.linalg.norm(normal)
    middle = grid.to_index(0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))[None])[0]
    cuts = []
    for index in indices:
        place = middle.copy()
        place[axis] = index
        cuts.append(Cut(grid.to_world(place[None])[0], normal, Plane(0, axis, int(index))))
    return cuts


def reached(mesh: Mesh, grid: Grid, axis: int) -> range:
    """Indices of the grid's planes along an axis that cut the surface."""
    places = grid.to_index(mesh.vertices)[:, axis]
    low, high = int(np.ceil(places.min())), int(np.floor(places.max()))
    return range(max(low, 0), min(high, grid.shape[axis] - 1) + 1)


def free_cuts(mesh: Mesh, directions: int, offsets: Sequence[float]) -> list[Cut]:
    """Planes of evenly spread directions, at these shares of the surface's extent along each."""
    number = np.arange(directions)
    height = (number + 0.5) / directions
    radius, turn = np.sqrt(1.0 - np.square(height)), GOLDEN_ANGLE * number
    normals = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    return [cut for normal in normals for cut in _across(mesh, normal, offsets)]


def nearby_cuts(mesh: Mesh, cut: Cut, tilt: float, shift: float) -> list[Cut]:
    """A free plane tilted (rad) and shifted (share of the extent) both ways."""
    across = np.linalg.svd(cut.normal[None])[2][1:]
    places = mesh.vertices @ cut.normal
    step = shift * float(np.ptp(places)) * cut.normal
    moved = [Cut(cut.origin + sign * step, cut.normal) for sign in (-1.0, 1.0)]
    for direction in across:
        for sign in (-1.0, 1.0):
            normal = np.cos(tilt) * cut.normal + sign * np.sin(tilt) * direction
            moved.append(Cut(cut.origin, normal / np.linalg.norm(normal)))
    return moved


def _across(mesh: Mesh, normal: Float[np.ndarray, "3"], offsets: Sequence[float]) -> list[Cut]:
    places = mesh.vertices @ normal
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    low, high = float(places.min()), float(places.max())
    return [Cut(middle + (low + share * (high - low) - float(middle @ normal)) * normal, normal) for share in offsets]
