"""Figure panels A to E as PNG bytes."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from model.bundle import ShapeModel
from model.inference.one_body import body_probability
from model.inference.reconstruction import SURFACE_SD, Options, reconstruct
from model.inference.sampling import draw_shape
from model.inference.surface import canonical_box, covering_grid
from model.inference.uncertainty import voxel_entropy
from training.cohorts.cohort import Case
from training.config import Regime
from training.rendering import STEPS, TRUTH_COLOUR, Surface, axes_around, show, surface_error, truth_surface
from training.sparsify import body_axes, for_evaluation
from training.sweep.table import Result

#: Errors are coloured up to this many times the case's average surface distance.
SCALE = 4.0
DPI = 80
NAMES = ("axial", "coronal", "sagittal")


def best_median_worst(result: Result, regime: str) -> dict[str, str]:
    """Cases by average surface distance, by word; fewer when there are fewer cases."""
    found = {case: values["asd_mm"] for case, values in result.measured[regime].items() if values is not None}
    ordered = sorted(found, key=found.__getitem__)
    if not ordered:
        return {}
    places = {"best": 0, "median": len(ordered) // 2, "worst": len(ordered) - 1}
    return {word: ordered[place] for word, place in places.items()}


def reconstructions(
    models: dict[str, ShapeModel], cases: dict[str, Case], choices: dict[str, str], regime: Regime
) -> bytes:
    """A: truth, and each model's reconstruction coloured by its distance to the truth; one row a choice."""
    columns = 1 + len(models)
    figure = Figure(figsize=(3.0 * columns, 2.9 * len(choices)), layout="constrained")
    for row, (word, name) in enumerate(choices.items()):
        case = cases[name]
        truth = truth_surface(case)
        axes = axes_around(figure, (len(choices), columns, columns * row + 1), truth.vertices)
        show(axes, truth, TRUTH_COLOUR)
        axes.set_title(f"{word}: truth", fontsize=9)
        for column, (title, model) in enumerate(models.items(), start=2):
            _reconstruction(figure, (len(choices), columns, columns * row + column), model, case, regime, title)
    return _png(figure)


def _reconstruction(
    figure: Figure, place: tuple[int, int, int], model: ShapeModel, case: Case, regime: Regime, title: str
) -> None:
    drawing = for_evaluation(case.mask, case.grid, regime)
    options = Options(annotated=drawing.planes, uncertainty="none", resolution_mm=_step(model))
    mesh = reconstruct(model, [drawing.stack], options).mesh
    if mesh.is_empty:
        return
    surface = Surface(mesh.vertices, np.asarray(mesh.faces, np.int64))
    error = surface_error(case, surface)
    scale = Normalize(0.0, max(SCALE * float(error.mean()), 1e-3))
    axes = axes_around(figure, place, truth_surface(case).vertices)
    show(axes, surface, colormaps["viridis"](scale(error[surface.faces].mean(axis=1)))[:, :3])
    axes.set_title(title, fontsize=9)
    _bar(figure, axes, scale, "viridis", "distance to the truth (mm)")


def sorted_sigmas(results: Sequence[Result]) -> bytes:
    """B: sigmas of the base from the largest on, as shares of it."""
    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = figure.add_subplot()
    for result in sorted(results, key=lambda one: one.latent_size):
        sigmas = np.array(result.sigmas)
        share = np.arange(1, len(sigmas) + 1) / len(sigmas)
        axes.plot(
            share, sigmas / sigmas[0], label=f"D = {result.latent_size}, trained on {result.regime}", linewidth=1.2
        )
    axes.set_xlabel("share of the dimensions, largest first")
    axes.set_ylabel("sigma by the largest")
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return _png(figure)


def correlation_plot(result: Result, r_squared: float, pearson: float) -> bytes:
    """C: distance in z0 against surface distance of generated shapes to the nearest training shape."""
    figure = Figure(figsize=(4.4, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(result.latent, result.surface_mm, ".", markersize=3, alpha=0.4)
    if np.ptp(result.latent) > 0:
        slope, start = np.polyfit(result.latent, result.surface_mm, 1)
        ends = np.array([min(result.latent), max(result.latent)])
        axes.plot(ends, start + slope * ends, color="#c2185b", linewidth=1.5)
    axes.set_xlabel("distance in z0 to the nearest training code")
    axes.set_ylabel("surface distance (mm)")
    axes.set_title(f"D = {result.latent_size}, R$^2$ = {r_squared:.2f}, r = {pearson:.2f}", fontsize=9)
    axes.grid(alpha=0.3)
    return _png(figure)


def uncertainty(model: ShapeModel, case: Case, regime: Regime) -> bytes:
    """D: posterior standard deviation on the surface, and voxel entropy in three sections through its middle."""
    drawing = for_evaluation(case.mask, case.grid, regime)
    options = Options(annotated=drawing.planes, uncertainty="laplace", resolution_mm=_step(model))
    answer = reconstruct(model, [drawing.stack], options)
    figure = Figure(figsize=(11.0, 3.0), layout="constrained")
    surface = Surface(answer.mesh.vertices, np.asarray(answer.mesh.faces, np.int64))
    spread = answer.mesh.scalars[SURFACE_SD]
    scale = Normalize(0.0, float(np.quantile(spread, 0.98)))
    axes = axes_around(figure, (1, 4, 1), surface.vertices)
    show(axes, surface, colormaps["magma"](scale(spread[surface.faces].mean(axis=1)))[:, :3])
    axes.set_title("on the surface", fontsize=9)
    _bar(figure, axes, scale, "magma", "SD (mm)")
    grid = covering_grid(answer.mesh, max(1.0, _step(model) / 2.0))
    entropy = voxel_entropy(body_probability(model, answer.state, answer.mesh, grid))
    truth = case.grid.to_index(grid.centres())
    inside = _looked_up(case, truth).reshape(grid.shape)
    right, front, up = body_axes(grid)
    for number, (name, axis) in enumerate(zip(NAMES, (up, front, right), strict=True), start=2):
        _section(figure.add_subplot(1, 4, number), entropy, inside, axis, name)
    return _png(figure)


def generated_shapes(model: ShapeModel, count: int = 6) -> bytes:
    """E: the first shapes of the prior."""
    figure = Figure(figsize=(2.2 * count, 2.3), layout="constrained")
    box = canonical_box(model)
    corners = np.array([-box, box])
    for seed in range(count):
        mesh = draw_shape(model, seed, spacing_mm=_step(model)).mesh
        axes = axes_around(figure, (1, count, seed + 1), corners)
        if not mesh.is_empty:
            show(axes, Surface(mesh.vertices, np.asarray(mesh.faces, np.int64)), TRUTH_COLOUR)
    return _png(figure)


def _section(axes: Any, entropy: Any, inside: Any, axis: int, name: str) -> None:
    index = entropy.shape[axis] // 2
    shown = axes.imshow(np.take(entropy, index, axis=axis).T, origin="lower", cmap="magma", vmin=0.0, vmax=np.log(2.0))
    section = np.take(inside, index, axis=axis).T.astype(float)
    if 0.0 < section.mean() < 1.0:
        axes.contour(section, levels=[0.5], colors="#4dd0e1", linewidths=0.8)
    axes.set_title(name, fontsize=9)
    axes.set_axis_off()
    axes.figure.colorbar(shown, ax=axes, shrink=0.7).set_label("entropy (nats)", fontsize=8)


def _looked_up(case: Case, index: Any) -> Any:
    nearest = np.rint(index).astype(int)
    within = ((nearest >= 0) & (nearest < np.array(case.mask.shape))).all(axis=1)
    found = np.zeros(len(nearest), bool)
    found[within] = case.mask[tuple(nearest[within].T)]
    return found


def _step(model: ShapeModel) -> float:
    return float(np.clip(2.0 * max(model.manifest.half_extent_mm) / STEPS, 1.0, 10.0))


def _bar(figure: Figure, axes: Any, scale: Normalize, colours: str, words: str) -> None:
    figure.colorbar(ScalarMappable(scale, colormaps[colours]), ax=axes, shrink=0.7).set_label(words, fontsize=8)


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=DPI)
    return stream.getvalue()
