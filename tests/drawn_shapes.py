"""Sparse drawings of analytic shapes, as a caller would send them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from model.bundle import ShapeModel
from model.geometry import Grid, Pose
from model.inference.observations import MaskStack, Observations, Plane, find_planes, observe, section_of
from tests.analytic_shapes import Ellipsoid

#: Three planes through the middle of a grid of 41 voxels.
ORTHOGONAL = (Plane(0, 0, 20), Plane(0, 1, 20), Plane(0, 2, 20))
#: Five planes across the last axis of the same.
PARALLEL = tuple(Plane(0, 2, index) for index in (14, 17, 20, 23, 26))


def finer(planes: Sequence[Plane]) -> tuple[Plane, ...]:
    """The same planes on a grid of 81 voxels at half the step."""
    return tuple(Plane(plane.stack, plane.axis, 2 * plane.index) for plane in planes)


class Shape(Protocol):
    """Anything that fills voxels."""

    def mask(self, grid: Grid) -> Bool[np.ndarray, "i j k"]:
        """Voxels whose centre lies inside."""
        ...


@dataclass(frozen=True)
class DecodedShape:
    """A member of a model's own family."""

    model: ShapeModel
    latent: Float[np.ndarray, "d"]
    pose: Pose

    def mask(self, grid: Grid) -> Bool[np.ndarray, "i j k"]:
        """Voxels whose centre lies inside."""
        points = self.pose.to_canonical(grid.centres())
        return (self.model.decoder.logits(self.latent[None], points[None])[0] > 0).reshape(grid.shape)


def rotation(degrees: float, axis: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Float[np.ndarray, "3 3"]:
    """Rotation about an axis."""
    return np.asarray(Rotation.from_rotvec(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis)).as_matrix())


def cube_around(
    centre: Float[np.ndarray, "3"], *, step: float = 1.0, nodes: int = 41, turn: Float[np.ndarray, "3 3"] | None = None
) -> Grid:
    """Cubic grid whose middle voxel lies at a point (mm), its axes turned."""
    affine = np.eye(4)
    affine[:3, :3] = step * (np.eye(3) if turn is None else turn)
    affine[:3, 3] = centre - affine[:3, :3] @ np.full(3, (nodes - 1) / 2)
    return Grid((nodes, nodes, nodes), affine)


def drawn(shape: Shape, grid: Grid, planes: Sequence[Plane] = ORTHOGONAL) -> MaskStack:
    """The shape drawn on some planes of a grid and nowhere else."""
    dense = shape.mask(grid)
    foreground = np.zeros_like(dense)
    for plane in planes:
        section_of(foreground, plane)[...] = section_of(dense, plane)
    return MaskStack("mask[0]", grid, foreground, np.zeros_like(dense))


def observed(stack: MaskStack, planes: Sequence[Plane] = ORTHOGONAL, *, seed: int = 0) -> Observations:
    """Observations on the planes."""
    return observe([stack], find_planes([stack], planes), budget=2500, seed=seed)


def shape_matrix(
    axes: Float[np.ndarray, "3"] | tuple[float, float, float], turn: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "3 3"]:
    """Symmetric matrix (mm) of an ellipsoid, the same however its axes are numbered: ``R diag(a) R^T``."""
    return np.asarray(turn @ np.diag(axes) @ turn.T)


def matrix_of(ellipsoid: Ellipsoid) -> Float[np.ndarray, "3 3"]:
    """`shape_matrix` of an ellipsoid."""
    return shape_matrix(ellipsoid.semi_axes, ellipsoid.rotation)
