"""Triangles on a page: surfaces with plain shading, coloured by a value if there is one."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.ndimage import map_coordinates
from skimage import measure

from training.cohorts.cohort import Case
from training.distance import signed_distance

#: Largest number of grid steps along a drawn surface, which keeps the number of triangles down.
STEPS = 60
LIGHT = np.array([0.3, -0.8, 0.5])
ELEVATION, AZIMUTH = 20.0, -60.0
TRUTH_COLOUR = (0.80, 0.82, 0.86)


@dataclass(frozen=True)
class Surface:
    """Triangles in the world (mm)."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def truth_surface(case: Case) -> Surface:
    """Surface of a dense mask."""
    padded = np.pad(case.mask, 1).astype(np.float32)
    step = max(1, round(max(case.mask.shape) / STEPS))
    library: Any = measure
    vertices, faces, _, _ = library.marching_cubes(padded, 0.5, step_size=step)
    return Surface(case.grid.to_world(vertices - 1.0), np.asarray(faces, np.int64))


def surface_error(case: Case, surface: Surface) -> Float[np.ndarray, "v"]:
    """Distance (mm) of each vertex to the surface of a dense mask, from its distance field."""
    room = 8
    field = signed_distance(np.pad(case.mask, room), case.grid.spacing)
    index = case.grid.to_index(surface.vertices) + room
    return np.asarray(np.abs(map_coordinates(field, index.T, order=1, mode="nearest")))


def axes_around(figure: Figure, place: tuple[int, int, int], world: Float[np.ndarray, "n 3"]) -> Any:
    """An empty 3-D view at a place (rows, columns, number) of a figure, its limits those of some points."""
    axes: Any = figure.add_subplot(*place, projection="3d")
    middle, half = (world.max(axis=0) + world.min(axis=0)) / 2.0, np.ptp(world, axis=0).max() / 2.0
    for set_limits, centre in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
        set_limits(centre - half, centre + half)
    axes.set_box_aspect((1, 1, 1), zoom=1.4)
    axes.view_init(ELEVATION, AZIMUTH)
    axes.set_axis_off()
    axes.computed_zorder = False
    return axes


def show(axes: Any, surface: Surface, colours: Any) -> None:
    """Triangles with plain shading."""
    corners = surface.vertices[surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    light = 0.45 + 0.55 * np.abs(across / lengths @ (LIGHT / np.linalg.norm(LIGHT)))
    shaded = np.broadcast_to(np.asarray(colours), (len(corners), 3)) * light[:, None]
    axes.add_collection3d(
        Poly3DCollection(corners, facecolors=np.clip(shaded, 0.0, 1.0), linewidths=0, antialiased=False)
    )
