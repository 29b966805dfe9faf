"""Surfaces as few points with normals, and the distance of two of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from skimage import measure

from model.bundle import ShapeModel
from model.geometry import Pose
from model.inference.mesh import Mesh, area_cm2, components, mesh_of, vertex_areas, volume_ml
from model.inference.surface import surface_of
from training.cohorts.cohort import Case
from training.distance import signed_distance

#: Points of a surface, and directions of its support function.
POINTS, DIRECTIONS = 400, 64
#: Of a population the surfaces that are nearest by their support functions are compared in full.
CANDIDATES = 8


@dataclass(frozen=True)
class Surface:
    """A surface around its own centroid (mm).

    Attributes:
        points, normals: some of its vertices.
        support: largest extent along fixed directions.
        parts: connected components of the mesh it was taken from.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    support: Float[np.ndarray, "k"]
    volume_ml: float
    area_cm2: float
    parts: int


def surface_from(mesh: Mesh) -> Surface:
    """Points of a mesh that is not empty."""
    centre = np.average(mesh.vertices, axis=0, weights=vertex_areas(mesh))
    moved = mesh.vertices - centre
    some = slice(None, None, -(-len(moved) // POINTS))
    support = (moved @ _directions().T).max(axis=0)
    return Surface(moved[some], mesh.normals[some], support, volume_ml(mesh), area_cm2(mesh), components(mesh)[0])


def surface_of_mask(case: Case, *, mirrored: bool = False) -> Surface:
    """Surface of a dense mask, from its signed distance; mirrored left to right when asked to."""
    field = signed_distance(np.pad(case.mask, 2), case.grid.spacing)
    library: Any = measure
    vertices, faces, _, _ = library.marching_cubes(field, 0.0, gradient_direction="ascent")
    world = case.grid.to_world(vertices - 2.0)
    mesh = mesh_of(world, np.asarray(faces, np.int64))
    if volume_ml(mesh) < 0:
        mesh = mesh_of(world, np.ascontiguousarray(mesh.faces[:, ::-1]))
    if mirrored:
        mesh = mesh_of(world * [-1.0, 1.0, 1.0], np.ascontiguousarray(mesh.faces[:, ::-1]))
    return surface_from(mesh)


def decoded(model: ShapeModel, latent: Float[np.ndarray, "d"], spacing_mm: float) -> Surface | None:
    """Surface of a code with all of its parts; None when there is none."""
    mesh = surface_of(model, latent, Pose(), spacing_mm, keep_specks=True)
    return None if mesh.is_empty else surface_from(mesh)


def distance_mm(first: Surface, second: Surface) -> float:
    """Mean of both directions' mean distances (mm), points to the tangent planes at the other's nearest points."""
    return (_one_way(first, second) + _one_way(second, first)) / 2.0


def _one_way(first: Surface, second: Surface) -> float:
    _, nearest = cKDTree(second.points).query(first.points)
    along = np.sum((first.points - second.points[nearest]) * second.normals[nearest], axis=1)
    return float(np.abs(along).mean())


def nearest_mm(surface: Surface, population: Sequence[Surface], *, leave_out: Sequence[int] = ()) -> float:
    """Distance (mm) to the nearest of a population, some of its members left out."""
    supports = np.stack([member.support for member in population])
    gaps = np.linalg.norm(supports - surface.support, axis=1)
    gaps[list(leave_out)] = np.inf
    chosen = np.argsort(gaps)[:CANDIDATES]
    return min(distance_mm(surface, population[int(i)]) for i in chosen if np.isfinite(gaps[i]))


def _directions() -> Float[np.ndarray, "k 3"]:
    """Directions spread evenly over the sphere (Fibonacci)."""
    number = np.arange(DIRECTIONS) + 0.5
    height, angle = 1.0 - 2.0 * number / DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * number
    ring = np.sqrt(1.0 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
