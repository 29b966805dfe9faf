"""The methods as functions from a drawing and a grid to a dense mask; each imports its libraries when it is made."""

import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from benchmarks.accuracy.names import MethodName
from model.errors import InvalidParameter
from model.geometry import Grid
from model.inference.reconstruction import Options
from training.oblique import SliceStacks


@dataclass(frozen=True)
class Filled:
    """A dense mask and the seconds that its fit took, None for methods without one."""

    mask: Bool[np.ndarray, "i j k"]
    fit_s: float | None = None


Fill = Callable[[SliceStacks, Grid], Filled]


@dataclass(frozen=True)
class Sources:
    """Where learned methods find what they learned, and the threads that any method may use.

    Attributes:
        bundle: folder of the shape model.
        modes: file of the PCA's modes; None when that method is not measured.
    """

    bundle: Path
    modes: Path | None
    threads: int = 1


def has_fidelity() -> bool:
    """Whether the project's field can be had without the slices' residual."""
    return "fidelity" in {field.name for field in fields(Options)}


def make_fill(method: MethodName, sources: Sources) -> Fill:
    """A method, its libraries and learned parts loaded."""
    match method:
        case MethodName.PROJECT:
            return project_fill(sources, {})
        case MethodName.ALONE:
            return project_fill(sources, {"fidelity": 0.0})
        case MethodName.ADAM:
            return adam_fill(sources)
        case MethodName.SIGNED_DISTANCE:
            return signed_distance_fill()
        case MethodName.ITK:
            return contour_fill()
        case MethodName.PCA:
            return modes_fill(sources)


def project_fill(sources: Sources, choices: dict[str, float]) -> Fill:
    """The project through its public functions."""
    from model.bundle import open_bundle
    from model.inference.one_body import body_mask
    from model.inference.reconstruction import reconstruct

    model = open_bundle(sources.bundle, threads=sources.threads)

    def fill(drawing: SliceStacks, grid: Grid) -> Filled:
        begin, stages = time.perf_counter(), dict[str, float]()
        options = Options(annotated=drawing.planes, uncertainty="none", **choices)  # type: ignore[arg-type]

        def watch(stage: str) -> None:
            stages[stage] = time.perf_counter() - begin

        found = reconstruct(model, drawing.stacks, options, watch)
        return Filled(body_mask(model, found.state, found.mesh, grid), stages.get("surface"))

    return fill


def adam_fill(sources: Sources) -> Fill:
    """The predecessor's algorithm with the decoder of the same bundle."""
    import torch

    from model.bundle import read_manifest
    from training.baselines.predecessor import AdamSettings, TorchDecoder, filled, fit_by_adam

    torch.set_num_threads(sources.threads)
    decoder = TorchDecoder(sources.bundle, read_manifest(sources.bundle)[0])

    def fill(drawing: SliceStacks, grid: Grid) -> Filled:
        begin = time.perf_counter()
        found = fit_by_adam(decoder, drawing.stacks, drawing.planes, AdamSettings())
        fit_s = time.perf_counter() - begin
        return Filled(filled(decoder, found, grid), fit_s)

    return fill


def modes_fill(sources: Sources) -> Fill:
    """PCA of signed-distance fields, its settings chosen before on validation shapes."""
    from training.baselines.distance_fit import filled, fit_modes
    from training.baselines.kept_modes import read_chosen

    chosen = read_chosen(_needed(sources.modes))

    def fill(drawing: SliceStacks, grid: Grid) -> Filled:
        begin = time.perf_counter()
        found = fit_modes(chosen.modes, drawing.stacks, drawing.planes, chosen.settings)
        fit_s = time.perf_counter() - begin
        return Filled(filled(chosen.modes, found, grid), fit_s)

    return fill


def _needed(modes: Path | None) -> Path:
    if modes is None:
        raise InvalidParameter("PCA was asked for without its modes; their file is accepted.", part="modes")
    return modes


def signed_distance_fill() -> Fill:
    """Shape-based interpolation of parallel slices."""
    from training.baselines.interpolation import signed_distance_interpolation

    return lambda drawing, grid: Filled(signed_distance_interpolation(drawing.stacks[0], drawing.planes, grid))


def contour_fill() -> Fill:
    """ITK's morphological interpolation."""
    from training.baselines.contours import contour_fill as fill
    from training.sparsify import Drawing

    return lambda drawing, grid: Filled(fill(Drawing(drawing.stacks[0], drawing.planes), grid))
