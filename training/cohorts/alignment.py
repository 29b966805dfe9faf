"""Groupwise rigid alignment: every shape is turned and moved to the evolving mean of all.

Signed distances are registered to their mean by SimpleITK (Euler transform, mean squares), beginning at the training
shape of median volume and in several rounds. No voxel is resampled: a case keeps its mask, its grid is turned in the
world. Shapes of one round see the same mean, and the mean of all transforms is taken off, so that the group as a
whole stays where it was.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
import SimpleITK as sitk
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from model.geometry import Grid
from training.cohorts.cohort import Case, Cohort
from training.cohorts.inspect import bounding_box
from training.distance import signed_distance
from training.placing import centroid, inner_points

#: Voxels along the longest side of the grid on which shapes are compared, and room around them (share of a half side).
SIDE, ROOM = 40, 1.3
ROUNDS = 3
#: Distances are compared up to this share of the grid's half side.
CLIP = 0.25
ITERATIONS = 60
#: Share of the voxels that a comparison takes.
SAMPLED = 0.2
#: Principal axes are followed only where they explain the mean so much better than the shape as it lies.
LIKELIER = 0.7
#: Inner voxels without which principal axes are not known.
LEAST_INSIDE = 4
#: Voxels around the object at least: ITK filters no fewer than four along an axis.
LEAST_PAD = 2

#: Called after each registration: how many are done, of how many.
Watch = Callable[[int, int], None]


@dataclass(frozen=True)
class Placed:
    """Signed distance (mm, positive inside) of a shape about its centroid.

    Attributes:
        field: its values on the case's own voxels, cropped to the object with a margin.
        grid: these voxels, the centroid at the origin.
        centroid: where that is in the world (mm).
    """

    field: Float[np.ndarray, "i j k"]
    grid: Grid
    centroid: Float[np.ndarray, "3"]


def align(cohort: Cohort, watch: Watch = lambda done, total: None) -> Cohort:
    """The cohort with each grid turned and moved; validation and test shapes go to the mean of the training shapes."""
    done = count(1)
    total = ROUNDS * len(cohort.train) + len(cohort.validation) + len(cohort.test)

    def advance() -> None:
        watch(next(done), total)

    placed = {case.name: _placed(case) for case in cohort.cases}
    common = _common_grid([placed[case.name] for case in cohort.train])
    turns = _groupwise([placed[case.name] for case in cohort.train], common, advance)
    mean = _mean([placed[case.name] for case in cohort.train], turns, common)
    found = dict(zip((case.name for case in cohort.train), turns, strict=True))
    for case in (*cohort.validation, *cohort.test):
        shape = placed[case.name]
        found[case.name] = registered(shape, mean, common, likely_start(shape, mean, common))
        advance()

    def turned(cases: Sequence[Case]) -> tuple[Case, ...]:
        return tuple(_turned(case, found[case.name], placed[case.name].centroid) for case in cases)

    return replace(cohort, train=turned(cohort.train), validation=turned(cohort.validation), test=turned(cohort.test))


def registered(
    shape: Placed, mean: Float[np.ndarray, "i j k"], common: Grid, start: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Rigid transform of a shape (about its centroid, mm) onto the mean."""
    library: Any = sitk
    reach = CLIP * SIDE / 2 * float(common.spacing[0])
    fixed, moving = (
        _image(np.clip(mean, -reach, reach), common),
        _image(np.clip(shape.field, -reach, reach), shape.grid),
    )
    method = library.ImageRegistrationMethod()
    method.SetMetricAsMeanSquares()
    method.SetMetricSamplingStrategy(method.RANDOM)
    method.SetMetricSamplingPercentage(SAMPLED, seed=1)
    method.SetInterpolator(library.sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(1.0, 1e-3, ITERATIONS, 0.6)
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetShrinkFactorsPerLevel([2, 1])
    method.SetSmoothingSigmasPerLevel([0.0, 0.0])
    # ITK maps points of the fixed image into the moving one: the inverse of what is looked for.
    transform = library.Euler3DTransform()
    inverse = np.linalg.inv(start)
    transform.SetMatrix(inverse[:3, :3].ravel().tolist())
    transform.SetTranslation(inverse[:3, 3].tolist())
    method.SetInitialTransform(transform, inPlace=True)
    method.Execute(fixed, moving)
    found = np.eye(4)
    found[:3, :3] = np.reshape(transform.GetMatrix(), (3, 3))
    found[:3, 3] = np.asarray(transform.GetTranslation())
    return np.asarray(np.linalg.inv(found))


def likely_start(shape: Placed, mean: Float[np.ndarray, "i j k"], common: Grid) -> Float[np.ndarray, "4 4"]:
    """Where to begin: as the shape lies, or its principal axes turned onto the mean's in one of four ways.

    A shape that is thinner than the voxels of the mean begins as it lies.
    """
    if min(int((mean > 0).sum()), int((shape.field > 0).sum())) < LEAST_INSIDE:
        return np.eye(4)
    target = _axes(mean > 0, common)
    own = _axes(shape.field > 0, shape.grid)
    signs = [np.diag(values) for values in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
    candidates = [np.eye(4) for _ in range(1 + len(signs))]
    for candidate, sign in zip(candidates[1:], signs, strict=True):
        candidate[:3, :3] = target @ sign @ own.T
    errors = [float(np.mean((_sampled(shape, turn, common) - mean) ** 2)) for turn in candidates]
    best = int(np.argmin(errors))
    return candidates[best] if errors[best] < LIKELIER * errors[0] else candidates[0]


def _axes(inside: Bool[np.ndarray, "i j k"], grid: Grid) -> Float[np.ndarray, "3 3"]:
    """Principal axes in the world as columns, right-handed."""
    world = inner_points(inside, grid)
    axes = np.linalg.svd(np.cov(world.T))[0]
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return np.asarray(axes)


def _groupwise(shapes: Sequence[Placed], common: Grid, advance: Callable[[], None]) -> list[Float[np.ndarray, "4 4"]]:
    volumes = [float((shape.field > 0).sum() * np.prod(shape.grid.spacing)) for shape in shapes]
    middle = int(np.argsort(volumes)[len(volumes) // 2])
    mean = _sampled(shapes[middle], np.eye(4), common)
    turns = [likely_start(shape, mean, common) for shape in shapes]
    for _ in range(ROUNDS):
        for number, shape in enumerate(shapes):
            turns[number] = registered(shape, mean, common, turns[number])
            advance()
        back = np.linalg.inv(_mean_transform(turns))
        turns = [back @ turn for turn in turns]
        mean = _mean(shapes, turns, common)
    return turns


def _mean_transform(turns: Sequence[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "4 4"]:
    found = np.eye(4)
    found[:3, :3] = Rotation.from_matrix(np.stack([turn[:3, :3] for turn in turns])).mean().as_matrix()
    found[:3, 3] = np.mean([turn[:3, 3] for turn in turns], axis=0)
    return found


def _mean(
    shapes: Sequence[Placed], turns: Sequence[Float[np.ndarray, "4 4"]], common: Grid
) -> Float[np.ndarray, "i j k"]:
    sampled = (_sampled(shape, turn, common) for shape, turn in zip(shapes, turns, strict=True))
    return np.asarray(sum(sampled) / len(shapes))


def _sampled(shape: Placed, turn: Float[np.ndarray, "4 4"], common: Grid) -> Float[np.ndarray, "i j k"]:
    """The distance field of a turned shape on the common grid; beyond its crop that of the crop's border."""
    inverse = np.linalg.inv(turn)
    index = shape.grid.to_index(common.centres() @ inverse[:3, :3].T + inverse[:3, 3])
    return np.asarray(map_coordinates(shape.field, index.T, order=1, mode="nearest")).reshape(common.shape)


def _placed(case: Case) -> Placed:
    box = bounding_box(case.mask)
    sides = np.array([side.stop - side.start for side in box])
    pad = np.ceil(0.35 * (sides * case.grid.spacing).max() / case.grid.spacing).astype(int)
    pad = np.maximum(pad, LEAST_PAD)
    field = signed_distance(np.pad(case.mask[box], [(int(width), int(width)) for width in pad]), case.grid.spacing)
    middle = centroid(case.mask, case.grid)
    affine = case.grid.affine.astype(float).copy()
    affine[:3, 3] = case.grid.to_world((np.array([side.start for side in box]) - pad)[None].astype(float))[0] - middle
    return Placed(field, Grid((field.shape[0], field.shape[1], field.shape[2]), affine), middle)


def _common_grid(shapes: Sequence[Placed]) -> Grid:
    """Cube of isotropic voxels about the origin that holds every shape, however it is turned."""
    reaches = [np.linalg.norm(inner_points(shape.field > 0, shape.grid), axis=1).max() for shape in shapes]
    half = ROOM * float(np.max(reaches))
    step = 2.0 * half / (SIDE - 1)
    affine = np.diag([step, step, step, 1.0])
    affine[:3, 3] = -half
    return Grid((SIDE, SIDE, SIDE), affine)


def _turned(case: Case, turn: Float[np.ndarray, "4 4"], centroid: Float[np.ndarray, "3"]) -> Case:
    to_centroid, back = np.eye(4), np.eye(4)
    to_centroid[:3, 3], back[:3, 3] = -centroid, centroid
    turned = Grid(case.grid.shape, back @ turn @ to_centroid @ case.grid.affine)
    return replace(case, grid=turned, stored=case.stored or case.grid)


def _image(values: Float[np.ndarray, "i j k"], grid: Grid) -> Any:
    """An ITK image in our own world, whose axes ITK need not know."""
    library: Any = sitk
    image = library.GetImageFromArray(np.ascontiguousarray(values.T.astype(np.float32)))
    image.SetSpacing(grid.spacing.tolist())
    image.SetDirection(grid.directions.ravel().tolist())
    image.SetOrigin(grid.affine[:3, 3].tolist())
    return image
