"""Extents of a surface: its width between two parallel planes (caliper diameter), and its longest diameter.

To first order an extent grows by as much as the surface moves out at the two vertices that decide it, along the line
between them.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist

from model.errors import InvalidParameter
from model.geometry import Space, ras_to
from model.inference.estimates import Estimate, estimate_of
from model.inference.mesh import Mesh
from model.inference.spread import SurfaceSpread

#: World directions with a name; ``longest`` is the largest distance between two points of the surface.
AXES = {"R": (1.0, 0.0, 0.0), "A": (0.0, 1.0, 0.0), "S": (0.0, 0.0, 1.0)}
LONGEST = "longest"
#: What is measured when nobody chooses.
USUAL_EXTENTS = (*AXES, LONGEST)
#: The same as a text.
USUAL_TEXT = ", ".join(USUAL_EXTENTS)
#: Extents that may be asked for together, at most.
MOST_EXTENTS = 32
#: More points than this that the longest diameter may join are thinned out before all their distances are taken.
MOST_CORNERS = 2000

#: Each of its digits can be read in one way only, so that the time to refuse a text is that to read it.
_NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class Extent:
    """One extent.

    Attributes:
        along: as it was asked for: ``R``, ``A``, ``S``, ``longest``, or three numbers.
        direction: unit vector in the world (RAS).
        extent_mm: with its interval.
    """

    along: str
    direction: tuple[float, float, float]
    extent_mm: Estimate


def parse_extents(text: str) -> tuple[str, ...]:
    """Names and directions separated by commas, each once: ``R, longest, 0.5 0 0.87``.

    Raises:
        InvalidParameter: something else, or too many.
    """
    words = list(dict.fromkeys(" ".join(word.split()) for word in text.split(",") if word.strip()))
    if len(words) > MOST_EXTENTS:
        raise InvalidParameter(f"extents names {len(words)}; at most {MOST_EXTENTS} are accepted.", part="extents")
    for word in words:
        direction_of(word)
    return tuple(words)


def direction_of(along: str, space: Space = "RAS") -> Float[np.ndarray, "3"] | None:
    """Unit direction (RAS) of a word, None for the longest diameter.

    Args:
        along: ``R``, ``A`` and ``S`` mean the same in every world, three numbers are of the one that is named.
        space: world of the numbers.

    Raises:
        InvalidParameter: neither a name nor three numbers, not all of them zero.
    """
    if along == LONGEST:
        return None
    if along in AXES:
        return np.array(AXES[along])
    numbers = along.split()
    if len(numbers) == 3 and all(map(_NUMBER.fullmatch, numbers)):
        vector = np.array([float(number) for number in numbers])
        with np.errstate(over="ignore"):
            length = float(np.linalg.norm(vector))
        if 0.0 < length < np.inf:
            return np.asarray(ras_to(space) @ vector / length)
    raise InvalidParameter(
        f"extents must hold R, A, S, {LONGEST} or three numbers with blanks between them that are not all zero, "
        "such as 0.5 0 0.87.",
        part="extents",
    )


def measure_extents(
    mesh: Mesh, spread: SurfaceSpread | None, extents: Sequence[str], space: Space = "RAS"
) -> tuple[Extent, ...]:
    """Extents of a surface in the order in which they were asked for, with 90 % intervals.

    Args:
        mesh: world RAS mm.
        space: world of the directions that are given as numbers.
    """
    return tuple(_measure(mesh, spread, along, direction_of(along, space)) for along in extents)


def _measure(mesh: Mesh, spread: SurfaceSpread | None, along: str, direction: Float[np.ndarray, "3"] | None) -> Extent:
    low, high = _farthest(mesh) if direction is None else _ends(mesh, direction)
    if direction is None:
        direction = mesh.vertices[high] - mesh.vertices[low]
        direction = direction / max(float(np.linalg.norm(direction)), 1e-9)
    slope = np.zeros(len(mesh.vertices))
    slope[high] += float(mesh.normals[high] @ direction)
    slope[low] -= float(mesh.normals[low] @ direction)
    value = float((mesh.vertices[high] - mesh.vertices[low]) @ direction)
    x, y, z = direction.tolist()
    return Extent(along, (x, y, z), estimate_of(value, slope, spread))


def _ends(mesh: Mesh, direction: Float[np.ndarray, "3"]) -> tuple[int, int]:
    places = mesh.vertices @ direction
    return int(np.argmin(places)), int(np.argmax(places))


def _farthest(mesh: Mesh) -> tuple[int, int]:
    try:
        corners = np.asarray(ConvexHull(mesh.vertices).vertices, np.int64)
    except QhullError:  # a surface without volume
        corners = np.arange(len(mesh.vertices))
    corners = corners[_far_out(mesh.vertices[corners])]
    corners = corners[:: -(-len(corners) // MOST_CORNERS)]
    gaps = cdist(mesh.vertices[corners], mesh.vertices[corners])
    first, second = np.unravel_index(int(np.argmax(gaps)), gaps.shape)
    # From low to high along the axis in which they differ most, so that the direction does not depend on the order.
    a, b = int(corners[first]), int(corners[second])
    step = mesh.vertices[b] - mesh.vertices[a]
    return (a, b) if step[np.argmax(np.abs(step))] >= 0 else (b, a)


def _far_out(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "k"]:
    """Numbers of the points that the longest of their distances may join.

    None is longer than a point's distance from any centre and the largest such distance together; a long one is found
    by going to the point that is farthest from some point, and to the one farthest from that.
    """
    start = points[np.argmax(_distances(points, points[0]))]
    gaps = _distances(points, start)
    end = points[np.argmax(gaps)]
    away = _distances(points, (start + end) / 2.0)
    return np.flatnonzero(away + away.max() >= gaps.max() * (1.0 - 1e-9))


def _distances(points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n"]:
    return np.asarray(np.linalg.norm(points - origin, axis=1))
