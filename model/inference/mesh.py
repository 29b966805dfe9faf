"""A triangle mesh with scalars on its vertices: measures, checks, transforms, components."""

from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

MM3_PER_ML = 1000.0
MM2_PER_CM2 = 100.0


@dataclass(frozen=True)
class Mesh:
    """Closed triangle mesh.

    Attributes:
        vertices: (v, 3) mm, world RAS.
        faces: (f, 3) vertex numbers, counter-clockwise seen from outside.
        normals: (v, 3) outward unit normals.
        scalars: named (v,) values, for example ``surface_sd_mm``.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    scalars: dict[str, Float[np.ndarray, "v"]] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Whether there is no face at all."""
        return len(self.faces) == 0

    def with_scalars(self, **scalars: Float[np.ndarray, "v"]) -> "Mesh":
        """The mesh with further scalars; those of the same name are replaced."""
        return replace(self, scalars={**self.scalars, **scalars})


def empty_mesh() -> Mesh:
    """A mesh without vertices and faces."""
    return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3)))


def mesh_of(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Mesh:
    """A mesh whose normals come from its faces."""
    return Mesh(vertices, faces, vertex_normals(vertices, faces))


def volume_ml(mesh: Mesh) -> float:
    """Enclosed volume (mL) by the divergence theorem; negative when the faces are inside out."""
    a, b, c = _corners(mesh.vertices - _middle(mesh.vertices), mesh.faces)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0 / MM3_PER_ML)


def area_cm2(mesh: Mesh) -> float:
    """Surface area (cm^2)."""
    return float(np.linalg.norm(_area_vectors(mesh.vertices, mesh.faces), axis=1).sum() / MM2_PER_CM2)


def vertex_areas(mesh: Mesh) -> Float[np.ndarray, "v"]:
    """Area that each vertex stands for: a third of its faces' (mm^2); the sum is the surface area."""
    third = np.linalg.norm(_area_vectors(mesh.vertices, mesh.faces), axis=1) / 3.0
    return np.bincount(mesh.faces.ravel(), np.repeat(third, 3), minlength=len(mesh.vertices)).astype(float)


def area_gradient(mesh: Mesh) -> Float[np.ndarray, "v 3"]:
    """Derivative of the surface area (mm^2) by vertex positions (mm); points along the mean curvature normal."""
    a, b, c = _corners(mesh.vertices, mesh.faces)
    normal = unit(np.cross(b - a, c - a))
    by_corner = np.stack([np.cross(c - b, normal), np.cross(a - c, normal), np.cross(b - a, normal)], axis=1) / -2.0
    number = mesh.faces.ravel()
    parts = by_corner.reshape(-1, 3)
    sums = [np.bincount(number, parts[:, axis], minlength=len(mesh.vertices)) for axis in range(3)]
    return np.asarray(np.stack(sums, axis=1))


def vertex_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Unit normals, faces weighted by area; a vertex without area gets the zero vector."""
    weighted = np.repeat(_area_vectors(vertices, faces), 3, axis=0)
    total = [np.bincount(faces.ravel(), weighted[:, axis], minlength=len(vertices)) for axis in range(3)]
    return unit(np.stack(total, axis=1).astype(float))


def unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Vectors scaled to length one; those of length zero stay zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0))


def is_watertight(mesh: Mesh) -> bool:
    """Whether each edge belongs to exactly two faces that run along it in opposite directions."""
    if mesh.is_empty:
        return False
    start, end = _directed_edges(mesh.faces)
    size = len(mesh.vertices)
    forward, backward = np.sort(start * size + end), np.sort(end * size + start)
    unique = bool((np.diff(forward) > 0).all())
    return unique and bool((start != end).all()) and np.array_equal(forward, backward)


def extents(mesh: Mesh) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lower and upper corner of the bounding box (mm)."""
    return mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)


def transformed(mesh: Mesh, affine: Float[np.ndarray, "4 4"]) -> Mesh:
    """The mesh under a similarity (rotation, uniform scale, translation, perhaps a mirroring).

    A mirroring reverses the order of each face's corners, so that faces and normals still point
    outwards. Scalars are carried over as they are.

    Args:
        affine: from the mesh's coordinates to the new ones, acting on columns.
    """
    linear = affine[:3, :3]
    faces = mesh.faces[:, ::-1] if np.linalg.det(linear) < 0 else mesh.faces
    vertices = mesh.vertices @ linear.T + affine[:3, 3]
    return Mesh(vertices, np.ascontiguousarray(faces), unit(mesh.normals @ linear.T), dict(mesh.scalars))


def components(mesh: Mesh) -> tuple[int, Int[np.ndarray, "v"]]:
    """Number of connected components and the component of each vertex."""
    start, end = _directed_edges(mesh.faces)
    size = len(mesh.vertices)
    adjacency = coo_array((np.ones(len(start), np.int8), (start, end)), shape=(size, size))
    count, component = connected_components(adjacency, directed=False)
    return int(count), component


def largest_component(mesh: Mesh) -> tuple[Mesh, int]:
    """The component that encloses most volume, and how many others were removed.

    Walls of enclosed cavities are components of their own and are removed as well.
    """
    keep, removed = of_largest_component(mesh)
    return (subset(mesh, keep) if removed else mesh), removed


def of_largest_component(mesh: Mesh) -> tuple[Bool[np.ndarray, "v"], int]:
    """Which vertices `largest_component` keeps, and how many components it removes."""
    count, component = components(mesh)
    if count <= 1:
        return np.ones(len(mesh.vertices), bool), 0
    a, b, c = _corners(mesh.vertices - _middle(mesh.vertices), mesh.faces)
    enclosed = np.bincount(component[mesh.faces[:, 0]], np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=count)
    return component == int(np.argmax(enclosed)), count - 1


def subset(mesh: Mesh, keep: Bool[np.ndarray, "v"]) -> Mesh:
    """Some of the vertices, and the faces between them."""
    number = np.cumsum(keep) - 1
    faces = number[mesh.faces[keep[mesh.faces[:, 0]]]]
    scalars = {name: values[keep] for name, values in mesh.scalars.items()}
    return Mesh(mesh.vertices[keep], faces, mesh.normals[keep], scalars)


def to_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    """The same mesh for trimesh, vertices and faces in the same order, scalars as vertex attributes."""
    result = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False, validate=False)
    result.vertex_attributes.update({name: np.asarray(values) for name, values in mesh.scalars.items()})
    return result


def _middle(vertices: np.ndarray) -> np.ndarray:
    return vertices.mean(axis=0) if len(vertices) else np.zeros(3)


def _corners(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]


def _area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = _corners(vertices, faces)
    return np.asarray(np.cross(b - a, c - a) / 2.0)


def _directed_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    wide = faces.astype(np.int64)
    return wide.ravel(), wide[:, [1, 2, 0]].ravel()
