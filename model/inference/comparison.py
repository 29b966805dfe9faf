"""How far one closed surface lies outside or inside another."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from trimesh import triangles

from model.inference.mesh import Mesh
from model.inference.nearest import candidate_faces, nearest_on_surface

#: Name of the scalar on a compared mesh.
SIGNED_DISTANCE = "signed_distance_mm"


def compared(mesh: Mesh, other: Mesh) -> Mesh:
    """The mesh whose only scalar is `SIGNED_DISTANCE`: positive where it lies outside the other one."""
    bare = Mesh(mesh.vertices, mesh.faces, mesh.normals)
    return bare.with_scalars(**{SIGNED_DISTANCE: signed_distance(mesh.vertices, other)})


def signed_distance(points: Float[np.ndarray, "n 3"], surface: Mesh) -> Float[np.ndarray, "n"]:
    """Distance (mm) of points to a closed surface, positive outside.

    The sign is that of the step from the nearest point along the surface's normals, interpolated there.
    """
    corners = surface.vertices[surface.faces]
    nearest = nearest_on_surface(points, corners, candidate_faces(points, corners))
    normal = _normals_at(surface, nearest.faces, nearest.places)
    return np.asarray(np.copysign(nearest.distance_mm, np.einsum("ij,ij->i", points - nearest.places, normal)))


def _normals_at(
    surface: Mesh, face: Int[np.ndarray, "n"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Normals of the vertices, interpolated at points on faces."""
    to_barycentric: Any = triangles.points_to_barycentric
    weights = to_barycentric(surface.vertices[surface.faces[face]], points)
    return np.asarray(np.einsum("nc,ncd->nd", weights, surface.normals[surface.faces[face]]))
