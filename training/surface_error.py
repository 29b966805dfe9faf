"""How far a surface lies from the true one: that of a dense mask."""

from typing import Any

import numpy as np
import SimpleITK as sitk
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from model.geometry import Grid

#: The surface of a mask strays from the shape's own by about this share of a voxel (RMS).
DIGITISED = 0.25
#: Voxels around a mask that is smoothed.
PADDING = 4


def true_points(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> Float[np.ndarray, "n 3"]:
    """Points (world mm) on the surface half-way between voxels of different label, closer together than voxels."""
    return _points(np.pad(mask, 1).astype(np.float32), 0.5, grid, 1)


def anti_aliased_points(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> Float[np.ndarray, "n 3"]:
    """Points on the smoothest surface that has the mask's voxels on their sides (Whitaker 2000), without its stairs."""
    library: Any = sitk
    image = library.GetImageFromArray(np.pad(mask, PADDING).astype(np.uint8))
    image.SetSpacing([float(step) for step in grid.spacing[::-1]])
    smooth = library.AntiAliasBinary(image, maximumRMSError=0.01, numberOfIterations=200)
    return _points(library.GetArrayFromImage(smooth), 0.0, grid, PADDING)


def _points(field: Float[np.ndarray, "i j k"], level: float, grid: Grid, padding: int) -> Float[np.ndarray, "n 3"]:
    extract: Any = marching_cubes
    vertices, faces, _, _ = extract(field, level)
    corners = grid.to_world(vertices - float(padding))
    triangles = corners[faces]
    edges = [0.5 * (triangles[:, a] + triangles[:, b]) for a, b in ((0, 1), (1, 2), (2, 0))]
    return np.concatenate([corners, triangles.mean(axis=1), *edges])


def distances_to(points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v"]:
    """Distance (mm) of each vertex from the nearest of the points."""
    return np.asarray(cKDTree(points).query(vertices)[0])


def digitisation_mm(grid: Grid) -> float:
    """RMS distance (mm) of a mask's surface from that of the shape which it digitises, about."""
    return DIGITISED * float(np.cbrt(np.prod(grid.spacing)))
