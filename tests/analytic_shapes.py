"""Shapes with exact answers: ellipsoids, boxes and tori with their volume, area, field and gradient."""

from dataclasses import dataclass, field

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.integrate import quad
from scipy.special import ellipeinc, ellipkinc

from model.geometry import Grid
from model.inference.mesh import Mesh, mesh_of


@dataclass(frozen=True)
class Ellipsoid:
    """Solid ellipsoid.

    Attributes:
        semi_axes: (3,) mm.
        centre: (3,) mm.
        rotation: (3, 3) from the ellipsoid's axes to the world.
    """

    semi_axes: tuple[float, float, float]
    centre: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))

    @property
    def volume_ml(self) -> float:
        """4/3 pi abc."""
        return float(4.0 / 3.0 * np.pi * np.prod(self.semi_axes) / 1000.0)

    @property
    def area_cm2(self) -> float:
        """By Legendre's incomplete elliptic integrals."""
        c, b, a = sorted(self.semi_axes)
        if np.isclose(a, c):
            return 4.0 * np.pi * a * a / 100.0
        phi = np.arccos(c / a)
        modulus = a * a * (b * b - c * c) / (b * b * (a * a - c * c))
        part = ellipeinc(phi, modulus) * np.sin(phi) ** 2 + ellipkinc(phi, modulus) * np.cos(phi) ** 2
        return float((2 * np.pi * c * c + 2 * np.pi * a * b / np.sin(phi) * part) / 100.0)

    def logits(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Positive inside, slope at most one a mm: ``min(a, b, c) (1 - |q|)``, q in units of the axes."""
        return np.asarray(min(self.semi_axes) * (1.0 - np.linalg.norm(self._unit(points), axis=1)))

    def logits_and_gradients(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
        """The same with the gradient (per mm)."""
        q = self._unit(points)
        radius = np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)
        gradient = -min(self.semi_axes) * (q / radius / np.array(self.semi_axes)) @ self.rotation.T
        return self.logits(points), gradient

    def mask(self, grid: Grid) -> Bool[np.ndarray, "i j k"]:
        """Voxels whose centre lies inside."""
        return (self.logits(voxel_centres(grid)) > 0).reshape(grid.shape)

    def _unit(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return np.asarray((points - self.centre) @ self.rotation / np.array(self.semi_axes))


def voxel_centres(grid: Grid) -> Float[np.ndarray, "n 3"]:
    """World positions of all voxel centres, last index fastest."""
    return grid.to_world(np.argwhere(np.ones(grid.shape, bool)).astype(float))


def sphere(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Ellipsoid:
    """A ball; its `logits` are the exact signed distance (mm)."""
    return Ellipsoid((radius, radius, radius), np.array(centre))


@dataclass(frozen=True)
class Box:
    """Solid box along the axes; thin in one direction it is a plate."""

    half_sizes: tuple[float, float, float]
    centre: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))

    @property
    def volume_ml(self) -> float:
        """8 abc."""
        return float(8.0 * np.prod(self.half_sizes) / 1000.0)

    @property
    def area_cm2(self) -> float:
        """8 (ab + bc + ca)."""
        a, b, c = self.half_sizes
        return 8.0 * (a * b + b * c + c * a) / 100.0

    @property
    def surface(self) -> Mesh:
        """Twelve triangles."""
        solid = trimesh.creation.box(2.0 * np.array(self.half_sizes))
        return mesh_of(np.array(solid.vertices) + self.centre, np.array(solid.faces))

    def logits(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Signed distance (mm), positive inside."""
        beyond = np.abs(points - self.centre) - np.array(self.half_sizes)
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return np.asarray(-outside - np.minimum(beyond.max(axis=1), 0.0))


@dataclass(frozen=True)
class Torus:
    """Solid ring around the z axis: a surface of genus one."""

    major: float
    minor: float

    @property
    def volume_ml(self) -> float:
        """2 pi^2 R r^2."""
        return 2.0 * np.pi**2 * self.major * self.minor**2 / 1000.0

    @property
    def area_cm2(self) -> float:
        """4 pi^2 R r."""
        return 4.0 * np.pi**2 * self.major * self.minor / 100.0

    def logits(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Signed distance (mm), positive inside."""
        ring = np.hypot(points[:, 0], points[:, 1]) - self.major
        return np.asarray(self.minor - np.hypot(ring, points[:, 2]))


def spheroid_area_cm2(equatorial: float, polar: float) -> float:
    """Area of a spheroid by quadrature of its profile, independent of the elliptic integrals above."""

    def ring(angle: float) -> float:
        slope = np.hypot(equatorial * np.cos(angle), polar * np.sin(angle))
        return float(2.0 * np.pi * equatorial * np.sin(angle) * slope)

    return float(quad(ring, 0.0, np.pi)[0] / 100.0)


def spread_on_a_ball(count: int, radius_mm: float) -> Float[np.ndarray, "n 3"]:
    """Points (mm) spread evenly on a ball around the origin, along a spiral of golden angles."""
    heights = np.linspace(-1.0, 1.0, count)
    around, turns = np.sqrt(1.0 - heights**2), np.pi * (3.0 - 5.0**0.5) * np.arange(count)
    return radius_mm * np.stack([around * np.cos(turns), around * np.sin(turns), heights], axis=1)
