"""What the service can do, as plain functions of domain types: no HTTP, no settings, no clock."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, UInt8

from model.bundle import ShapeModel
from model.errors import InvalidParameter, TooLarge, UnknownModel
from model.geometry import Grid, Pose, Space
from model.inference.comparison import compared
from model.inference.fitting import Fit, FitStatus
from model.inference.latent import LatentFeatures, latent_features, shape_between
from model.inference.mesh import Mesh
from model.inference.modes import ShapeModes, shape_along
from model.inference.next_plane import Among, NextPlane
from model.inference.next_plane import next_plane as best_plane
from model.inference.observations import AnnotatedRule, MaskStack, Plane, find_planes
from model.inference.one_body import body_mask, body_probability
from model.inference.posterior_shapes import PosteriorShape, draw_posterior
from model.inference.reconstruction import SURFACE_SD, Options, Watch, farthest_mm, unwatched
from model.inference.reconstruction import reconstruct as infer
from model.inference.sampling import SampledShape, draw_shape
from model.inference.stacks import label_warnings, require_length
from model.inference.surface import covering_grid, require_step
from model.inference.uncertainty import ShapeState, voxel_entropy
from model.interruption import Check, interruptible, unchecked
from service.cautions import coarse_cautions
from service.errors import NotComputed
from service.ports import Catalogue, MaskReader, MaskSource, ModeSource, Outcome

#: Largest seed; exact as a JSON number everywhere.
MAX_SEED = 2**53 - 1


def reconstruct(
    model: ShapeModel,
    stacks: tuple[MaskStack, ...],
    options: Options,
    max_voxels: int | None = None,
    watch: Watch = unwatched,
    check: Check = unchecked,
) -> Outcome:
    """Reconstruct the object of the stacks; the first one's grid is the input's grid.

    What the stacks' notes say is among the warnings, and whether the mesh is too coarse for the figures.

    Args:
        max_voxels: of the grid in which the surface is looked for; any number when None.
        watch: told the name of each stage as it begins.
        check: called many times a second; what it raises ends the work.

    Raises:
        InputError: the stacks or options cannot be used; the sentence says why.
    """
    require_length(stacks, farthest_mm(model))
    reconstruction = infer(interruptible(model, check), stacks, options, watch, max_voxels)
    manifest = model.manifest
    figure_ml, judged_mm = reconstruction.volume_ml.value, manifest.resolution_mm
    coarse = coarse_cautions(reconstruction.mesh, options.resolution_mm, figure_ml, judged_mm)
    told = replace(
        reconstruction, warnings=(*reconstruction.warnings, *notes_of(stacks), *label_warnings(stacks), *coarse)
    )
    return Outcome(manifest.name, manifest.version, model.digest, options, stacks[0].grid, told)


def stacks_of(
    read: MaskReader,
    masks: Iterable[MaskSource],
    labels: frozenset[int] | None,
    max_voxels: int,
    check: Check = unchecked,
) -> tuple[MaskStack, ...]:
    """The stacks of all masks of one drawing in their order; the check is passed before each mask.

    Raises:
        InputError: a mask cannot be used; names it as ``mask[0]``, ``mask[1]`` and so on.
        TooLarge: they have more voxels together than allowed.
    """
    stacks: list[MaskStack] = []
    for number, mask in enumerate(masks):
        check()
        part = f"mask[{number}]"
        stacks += read(mask, part, labels)
        if sum(stack.foreground.size for stack in stacks) > max_voxels:
            raise TooLarge(
                f"The masks up to {part} have more than {max_voxels} voxels together, the most that is accepted.",
                part=part,
            )
    return tuple(stacks)


def notes_of(stacks: Sequence[MaskStack]) -> tuple[str, ...]:
    """What the stacks' notes say, each once."""
    return tuple(dict.fromkeys(note for stack in stacks for note in stack.notes))


@dataclass(frozen=True)
class Volume:
    """A voxel array on its grid."""

    array: Float32[np.ndarray, "i j k"] | UInt8[np.ndarray, "i j k"]
    grid: Grid


def probability_map(
    catalogue: Catalogue, outcome: Outcome, spacing_mm: float | None, max_voxels: int, check: Check = unchecked
) -> Volume:
    """Occupancy probability on the input's grid, or on a grid around the surface at a spacing (mm).

    Args:
        check: here and below, called before each evaluation of the model; what it raises ends the work.

    Raises:
        NotComputed: the model that made the outcome is no longer loaded.
        TooLarge: the grid has more voxels than allowed.
    """
    model, grid = _model_and_grid(catalogue, outcome, spacing_mm, max_voxels, check)
    probability = body_probability(model, outcome.reconstruction.state, outcome.reconstruction.mesh, grid)
    return Volume(probability.astype(np.float32), grid)


def _model_and_grid(
    catalogue: Catalogue, outcome: Outcome, spacing_mm: float | None, max_voxels: int, check: Check
) -> tuple[ShapeModel, Grid]:
    model = interruptible(_same_model(catalogue, outcome), check)
    grid = outcome.grid if spacing_mm is None else covering_grid(outcome.reconstruction.mesh, spacing_mm)
    require_voxels(grid, max_voxels)
    return model, grid


def segmentation(
    catalogue: Catalogue, outcome: Outcome, spacing_mm: float | None, max_voxels: int, check: Check = unchecked
) -> Volume:
    """Label map, 1 where the object is more likely than not; grid and errors as in `probability_map`."""
    model, grid = _model_and_grid(catalogue, outcome, spacing_mm, max_voxels, check)
    inside = body_mask(model, outcome.reconstruction.state, outcome.reconstruction.mesh, grid)
    return Volume(inside.astype(np.uint8), grid)


def entropy_map(
    catalogue: Catalogue, outcome: Outcome, spacing_mm: float | None, max_voxels: int, check: Check = unchecked
) -> Volume:
    """Voxel entropy (nats); grid and errors as in `probability_map`, and `NotComputed` without uncertainty."""
    _require_uncertainty(outcome)
    volume = probability_map(catalogue, outcome, spacing_mm, max_voxels, check)
    return Volume(voxel_entropy(volume.array.astype(float)).astype(np.float32), volume.grid)


def surface_sd(outcome: Outcome) -> Float[np.ndarray, "v"]:
    """Standard deviation (mm) of the surface at each vertex; `NotComputed` without uncertainty."""
    _require_uncertainty(outcome)
    return outcome.reconstruction.mesh.scalars[SURFACE_SD]


def annotated_planes(stacks: tuple[MaskStack, ...], rule: AnnotatedRule | Sequence[Plane]) -> tuple[Plane, ...]:
    """The planes that `reconstruct` would use; errors as there, but that no model says how large the object may be."""
    return find_planes(stacks, rule)


def compare(outcome: Outcome, other: Outcome) -> Mesh:
    """Surface of an outcome with its signed distance (mm) to another's, both in the world of their inputs (RAS)."""
    return compared(outcome.reconstruction.mesh, other.reconstruction.mesh)


def next_plane(catalogue: Catalogue, outcome: Outcome, among: Among, check: Check = unchecked) -> NextPlane:
    """The plane that would reduce the expected uncertainty most.

    Raises:
        NotComputed: without uncertainty, or the model that made the outcome is no longer loaded.
        InvalidParameter: every plane of the input's grid that cuts the surface is drawn.
    """
    _require_uncertainty(outcome)
    answer = outcome.reconstruction
    model = interruptible(_same_model(catalogue, outcome), check)
    return best_plane(model, answer.state.fits[0], answer.mesh, outcome.grid, answer.planes, among)


@dataclass(frozen=True)
class Posterior:
    """Shapes that a reconstruction could also be.

    Attributes:
        spacing_mm: grid step of their surfaces; the model's when None.
    """

    model: ShapeModel
    outcome: Outcome
    spacing_mm: float | None

    def checked(self, check: Check) -> "Posterior":
        """The same, whose evaluations pass a check first."""
        return replace(self, model=interruptible(self.model, check))

    def draw(self, seed: int) -> PosteriorShape:
        """One of them, a pure function of the outcome, the spacing and the seed."""
        return draw_posterior(self.model, self.outcome.reconstruction.state, seed, self.spacing_mm)


def posterior(catalogue: Catalogue, outcome: Outcome, spacing_mm: float | None, max_voxels: int) -> Posterior:
    """The posterior of an outcome, at the outcome's resolution when no spacing is given.

    Raises:
        NotComputed: without uncertainty, or the model that made the outcome is no longer loaded.
        TooLarge: a surface's grid would have more voxels than allowed.
    """
    _require_uncertainty(outcome)
    model = _same_model(catalogue, outcome)
    step = outcome.options.resolution_mm if spacing_mm is None else spacing_mm
    log_scale = outcome.reconstruction.state.fits[0].pose.log_scale
    require_step(model, step, max_voxels, log_scale=log_scale)
    return Posterior(model, outcome, step)


def draw(
    model: ShapeModel,
    seed: int,
    temperature: float,
    spacing_mm: float | None,
    max_voxels: int,
    *,
    reject: bool = True,
) -> SampledShape:
    """One synthetic shape, drawn anew where it is implausible unless `reject` is off.

    Raises:
        InvalidParameter: temperature or spacing out of its range.
        TooLarge: the evaluated grid would have more voxels than allowed.
    """
    require_step(model, spacing_mm, max_voxels)
    return draw_shape(model, seed, temperature=temperature, spacing_mm=spacing_mm, reject=reject)


def batch_seeds(seed: int, count: int, max_count: int, beyond: str = "") -> range:
    """Seeds of a batch: item i has seed + i; `beyond` says to a caller who wants too many what takes more.

    Raises:
        TooLarge: more shapes than allowed.
        InvalidParameter: no shape at all, or a seed beyond the largest one.
    """
    if count < 1:
        raise InvalidParameter("The parameter count must be 1 or more.", part="count")
    if count > max_count:
        raise TooLarge(f"The parameter count must not be larger than {max_count}{beyond}.", part="count")
    if not 0 <= seed <= MAX_SEED - count + 1:
        raise InvalidParameter(f"The seeds of a batch must lie between 0 and {MAX_SEED}.", part="seed")
    return range(seed, seed + count)


def label_map(model: ShapeModel, shape: SampledShape, spacing_mm: float, max_voxels: int) -> Volume:
    """A synthetic shape as a label map in the model's canonical frame."""
    grid = covering_grid(shape.mesh, spacing_mm)
    require_voxels(grid, max_voxels)
    size = len(shape.latent) + 7
    fit = Fit(shape.latent, Pose(), FitStatus.CONVERGED, "Drawn, not fitted.", 0, 0.0, np.zeros((size, size)))
    return Volume(body_mask(model, ShapeState((fit,), None), shape.mesh, grid).astype(np.uint8), grid)


def modes_of(model: ShapeModel, modes: ModeSource, check: Check = unchecked) -> ShapeModes:
    """The modes of a model by rank."""
    return modes(interruptible(model, check))


def shape_along_modes(
    model: ShapeModel,
    modes: ShapeModes,
    coordinates: Mapping[int, float],
    spacing_mm: float | None,
    max_voxels: int,
    check: Check = unchecked,
) -> Mesh:
    """Surface at coordinates (SD) along modes by rank.

    Raises:
        UnknownMode: no mode of a rank.
        InvalidParameter: a coordinate out of its range, or so far out that there is no surface.
        TooLarge: the evaluated grid would have more voxels than allowed.
    """
    require_step(model, spacing_mm, max_voxels)
    return shape_along(interruptible(model, check), modes, coordinates, spacing_mm)


def features(catalogue: Catalogue, outcome: Outcome, modes: ModeSource, check: Check = unchecked) -> LatentFeatures:
    """The latent code of an outcome beside the training population's.

    Raises:
        NotComputed: the model that made the outcome is no longer loaded.
    """
    model, state = interruptible(_same_model(catalogue, outcome), check), outcome.reconstruction.state
    return latent_features(model, modes(model), state.fits[0], state.covariance)


@dataclass(frozen=True)
class Way:
    """The way from one outcome's code to another's, in the world of the first.

    Attributes:
        spacing_mm: grid step of the surfaces; the model's when None.
        space: in which the coordinates of that world are to be told.
    """

    model: ShapeModel
    start: Fit
    end: Fit
    spacing_mm: float | None
    space: Space

    def shape(self, at: float, check: Check = unchecked) -> Mesh:
        """Surface at a place, 0 the start and 1 the end; world RAS mm."""
        model = interruptible(self.model, check)
        return shape_between(model, self.start.latent, self.end.latent, self.start.pose, at, self.spacing_mm)


def way_between(
    catalogue: Catalogue, outcome: Outcome, other: Outcome, spacing_mm: float | None, max_voxels: int
) -> Way:
    """The way between two outcomes of one model.

    Raises:
        NotComputed: the model that made the outcomes is no longer loaded.
        InvalidParameter: two models made them.
        TooLarge: a surface's grid would have more voxels than allowed.
    """
    if outcome.model_digest != other.model_digest:
        raise InvalidParameter("Two models made the results; results of one model are accepted.", part="with")
    model = _same_model(catalogue, outcome)
    start, end = outcome.reconstruction.state.fits[0], other.reconstruction.state.fits[0]
    require_step(model, spacing_mm, max_voxels, log_scale=start.pose.log_scale)
    return Way(model, start, end, spacing_mm, outcome.reconstruction.space)


def describe(catalogue: Catalogue) -> Iterator[ShapeModel]:
    """The loaded models in order."""
    return (catalogue.get(name) for name in catalogue.names())


def require_voxels(grid: Grid, max_voxels: int) -> None:
    """Refuse a grid with more voxels than allowed, before anything of its size is made."""
    if np.prod([float(count) for count in grid.shape]) > max_voxels:
        raise TooLarge(
            f"The parameter spacing_mm asks for more than {max_voxels} voxels; ask for a coarser one.",
            part="spacing_mm",
        )


def _same_model(catalogue: Catalogue, outcome: Outcome) -> ShapeModel:
    gone = NotComputed("The model that made this reconstruction is no longer loaded; its summary and mesh are.")
    try:
        model = catalogue.get(f"{outcome.model_name}@{outcome.model_version}")
    except UnknownModel:
        raise gone from None
    if model.digest != outcome.model_digest:
        raise gone
    return model


def _require_uncertainty(outcome: Outcome) -> None:
    if SURFACE_SD not in outcome.reconstruction.mesh.scalars:
        raise NotComputed("This reconstruction was made without uncertainty; ask for laplace or ensemble.")
