"""The classical generator beside ours: a Gaussian over principal modes of signed-distance fields."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates
from skimage import measure

from benchmarks.generator.surfaces import Surface, surface_from
from model.inference.mesh import mesh_of, volume_ml
from training.baselines.distance_learning import learn_modes
from training.baselines.distance_modes import DistanceModes
from training.cohorts.cohort import Case
from training.distance import signed_distance
from training.placing import centroid

#: Signed distances are clipped here (mm), as in the benchmark of accuracy.
CLIP_MM = 10.0


def principal_modes(cases: Sequence[Case], count: int) -> DistanceModes:
    """The first so many modes of training masks."""
    modes = learn_modes(cases, CLIP_MM)
    kept = modes.modes[:, :count]
    return DistanceModes(modes.grid, modes.mean, np.ascontiguousarray(kept), modes.shares[:count], modes.clip_mm)


def surface_at(modes: DistanceModes, coefficients: Float[np.ndarray, "k"]) -> Surface | None:
    """Surface of coefficients; None when the field is nowhere positive."""
    field = modes.field(coefficients).reshape(modes.grid.shape)
    if field.max() <= 0 or field.min() >= 0:
        return None
    library: Any = measure
    vertices, faces, _, _ = library.marching_cubes(np.pad(field, 1, constant_values=-modes.clip_mm), 0.0)
    world = modes.grid.to_world(vertices - 1.0)
    mesh = mesh_of(world, np.asarray(faces, np.int64))
    turned = mesh if volume_ml(mesh) > 0 else mesh_of(world, np.ascontiguousarray(mesh.faces[:, ::-1]))
    return surface_from(turned)


def projected(modes: DistanceModes, case: Case) -> Surface | None:
    """A mask as the modes describe it: its field's coefficients by least squares, its centroid at the origin."""
    distance = np.clip(signed_distance(np.pad(case.mask, 8), case.grid.spacing), -modes.clip_mm, modes.clip_mm)
    index = case.grid.to_index(modes.grid.centres() + centroid(case.mask, case.grid)) + 8
    field = map_coordinates(distance, index.T, order=1, mode="constant", cval=-modes.clip_mm)
    scale = np.sum(modes.modes.astype(float) ** 2, axis=0)
    return surface_at(modes, np.asarray(modes.modes.T @ (field - modes.mean) / scale, float))


def drawn(modes: DistanceModes, count: int, seed: int) -> list[Surface]:
    """Surfaces of standard normal coefficients; those without a surface are left out."""
    coefficients = np.random.default_rng(seed).standard_normal((count, modes.modes.shape[1]))
    found = [surface_at(modes, row) for row in coefficients]
    return [surface for surface in found if surface is not None]
