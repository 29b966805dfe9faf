"""Frames, voxel grids and similarity poses.

World coordinates are RAS in mm; only what is told to others may be in LPS, the patient coordinates
of DICOM. The canonical frame of a model is RAS in mm as well, with its origin at the mean centroid of
the training shapes. A `Pose` takes world points into that frame:

    u = exp(s) R F (x - t)

with position ``t`` (mm, where the canonical origin lies in the world), rotation ``R = exp([w]x)``,
log scale ``s`` and ``F = diag(-1, 1, 1)`` for mirrored anatomy, identity otherwise.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

#: Worlds in which coordinates are told.
Space = Literal["RAS", "LPS"]
#: Two directions count as perpendicular when their cosine is below this (about 0.06 degrees).
SHEAR_TOLERANCE = 1e-3
#: Grids coincide when their corners lie within this distance (mm).
COINCIDENCE_TOLERANCE_MM = 1e-2
#: Position, rotation and log scale.
POSE_SIZE = 7


def ras_to(space: Space) -> Float[np.ndarray, "3 3"]:
    """Points and directions of RAS to a space, and back: it is its own inverse, and a rotation."""
    return np.diag([-1.0, -1.0, 1.0]) if space == "LPS" else np.eye(3)


@dataclass(frozen=True)
class Grid:
    """A regular voxel grid in the world.

    Attributes:
        shape: number of voxels along each index axis.
        affine: (4, 4) from voxel index (centre of a voxel) to world RAS mm.
    """

    shape: tuple[int, int, int]
    affine: Float[np.ndarray, "4 4"]

    @property
    def spacing(self) -> Float[np.ndarray, "3"]:
        """Voxel size along each index axis (mm)."""
        return np.asarray(np.linalg.norm(self.affine[:3, :3], axis=0))

    @property
    def directions(self) -> Float[np.ndarray, "3 3"]:
        """Unit world directions of the index axes, one a column."""
        return np.asarray(self.affine[:3, :3] / self.spacing)

    def to_world(self, index: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Voxel indices (may be fractional) to world mm."""
        return np.asarray(np.asarray(index, float) @ self.affine[:3, :3].T + self.affine[:3, 3])

    def to_index(self, world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """World mm to fractional voxel indices; inverse of `to_world`."""
        offset = np.asarray(world, float) - self.affine[:3, 3]
        return np.asarray(offset @ np.linalg.inv(self.affine[:3, :3]).T)

    def centres(self) -> Float[np.ndarray, "n 3"]:
        """World positions of all voxel centres, last index fastest."""
        index = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), axis=-1)
        return self.to_world(index.reshape(-1, 3).astype(float))

    def coincides_with(self, other: "Grid") -> bool:
        """Whether both grids have the same voxels to within `COINCIDENCE_TOLERANCE_MM`."""
        if self.shape != other.shape:
            return False
        last = np.array(self.shape) - 1.0
        corners = np.array([[0, 0, 0], last, [last[0], 0, 0], [0, last[1], 0]])
        gap = np.abs(self.to_world(corners) - other.to_world(corners)).max()
        return bool(gap <= COINCIDENCE_TOLERANCE_MM)


AnyGrid = TypeVar("AnyGrid", bound=Grid)


def slab(grid: AnyGrid, first: int, last: int) -> AnyGrid:
    """The planes of a grid from one index along its last axis to another, both included."""
    affine = grid.affine.copy()
    affine[:3, 3] += first * grid.affine[:3, 2]
    return replace(grid, shape=(*grid.shape[:2], last - first + 1), affine=affine)


@dataclass(frozen=True)
class CanonicalLattice:
    """Voxels of a canonical frame, around its origin.

    Attributes:
        voxels: along R, A and S.
        step_mm: between their centres.
    """

    voxels: tuple[int, int, int]
    step_mm: float

    @property
    def half_mm(self) -> Float[np.ndarray, "3"]:
        """Half distance between the centres of the first voxel and the last one along each axis."""
        return 0.5 * self.step_mm * (np.array(self.voxels) - 1.0)

    def points(self) -> Float[np.ndarray, "n 3"]:
        """Centres of all voxels (canonical mm), last axis fastest."""
        return np.asarray(self.step_mm * np.indices(self.voxels).reshape(3, -1).T - self.half_mm)

    def places(self, canonical: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 n"]:
        """Points (canonical mm) in steps of the lattice."""
        return np.ascontiguousarray(((canonical + self.half_mm) / self.step_mm).T)


@dataclass(frozen=True)
class Pose:
    """Similarity transform from world (RAS mm) to a model's canonical frame (RAS mm).

    Attributes:
        position: ``t``, world position of the canonical origin (mm).
        rotation: ``R``, (3, 3) proper rotation.
        log_scale: ``s``; canonical size is exp(s) times world size.
        mirrored: whether left and right are exchanged.
    """

    position: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    log_scale: float = 0.0
    mirrored: bool = False

    @property
    def linear(self) -> Float[np.ndarray, "3 3"]:
        """``exp(s) R F``."""
        flip = np.diag([-1.0 if self.mirrored else 1.0, 1.0, 1.0])
        return np.asarray(np.exp(self.log_scale) * self.rotation @ flip)

    def to_canonical(self, world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """World mm to canonical mm."""
        return np.asarray((world - self.position) @ self.linear.T)

    def to_world(self, canonical: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Canonical mm to world mm; inverse of `to_canonical`."""
        return np.asarray(canonical @ np.linalg.inv(self.linear).T + self.position)

    def gradient_to_world(self, gradient: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Gradient with respect to canonical points to gradient with respect to world points."""
        return np.asarray(gradient @ self.linear)

    def moved(self, step: Float[np.ndarray, "7"]) -> "Pose":
        """The pose after a step (position mm, rotation vector rad applied on the left, log scale)."""
        turn = Rotation.from_rotvec(step[3:6]).as_matrix()
        return Pose(self.position + step[:3], turn @ self.rotation, self.log_scale + float(step[6]), self.mirrored)

    def jacobian(
        self, canonical: Float[np.ndarray, "n 3"], gradient: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 7"]:
        """Derivative of a field's value at fixed world points with respect to a step of `moved`.

        Args:
            canonical: the points in the canonical frame (mm).
            gradient: the field's gradient there with respect to canonical coordinates.
        """
        turn = np.cross(canonical, gradient)
        scale = np.sum(canonical * gradient, axis=1, keepdims=True)
        return np.concatenate([-gradient @ self.linear, turn, scale], axis=1)
