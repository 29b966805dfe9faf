"""Reconstruction from sparse drawings measured against dense masks, beside what needs no model.

For each case and regime: the mask is made sparse (`sparsify.for_evaluation`), reconstructed, and the
reconstruction's occupancy above one half on the case's own grid is compared with the dense mask. The baselines get
the same drawing in the same run: signed-distance interpolation (parallel slices) and ITK's morphological contour
interpolation (parallel and orthogonal slices).
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from model.bundle import MANIFEST, Manifest, ShapeModel, open_bundle, read_manifest
from model.errors import InputError, InvalidParameter, UnknownModel
from model.geometry import Grid
from model.inference.one_body import body_mask
from model.inference.reconstruction import Options, reconstruct
from training.answerable import naming
from training.baselines.contours import contour_fill
from training.baselines.interpolation import signed_distance_interpolation
from training.cohorts.cohort import Case
from training.metrics_masks import MaskAgreement, agreement
from training.sparsify import Drawing, Regime, for_evaluation


class Method(StrEnum):
    """Ways from a drawing to a dense mask."""

    MODEL = "model"
    SIGNED_DISTANCE = "signed distance"
    ITK = "ITK contours"


#: Fills a case's grid from a drawing.
Fill = Callable[[Drawing, Grid], Bool[np.ndarray, "i j k"]]
Watch = Callable[["Measurement"], None]


@dataclass(frozen=True)
class Measurement:
    """One method on one case.

    Attributes:
        agreement: figures against the dense mask; None when the method could not take the drawing.
        seconds: from the drawing to the dense mask.
        refusal: why it could not, empty otherwise.
    """

    case: str
    regime: Regime
    method: Method
    agreement: MaskAgreement | None
    seconds: float
    refusal: str = ""


def find_bundle(name_or_folder: str, folders: Iterable[Path]) -> Path:
    """Folder of a bundle: one that was named, or a folder of this name among those given.

    Raises:
        UnknownModel: neither is there.
    """
    for folder in (Path(name_or_folder), *(root / name_or_folder for root in folders)):
        if (folder / MANIFEST).is_file():
            return folder
    if Path(name_or_folder).name != name_or_folder and not Path(name_or_folder).exists():
        raise UnknownModel(
            "The folder of the model does not exist; the name of a shipped model or the folder of a bundle is accepted."
        )
    raise UnknownModel("No such model; the name of a shipped model or the folder of a bundle is accepted.")


def given_bundle(folder: Path) -> Manifest:
    """Manifest of a bundle that was named by its folder.

    Raises:
        InvalidParameter: it is not there.
        BundleError: it is there and cannot be trusted.
    """
    if not folder.is_dir():
        raise InvalidParameter(
            "The folder of the bundle does not exist; one written by morphoflow export is accepted.", part="bundle"
        )
    if not (folder / MANIFEST).is_file():
        raise InvalidParameter(
            f"The bundle has no {MANIFEST}; a folder written by morphoflow export is accepted.", part="bundle"
        )
    return read_manifest(folder)[0]


def shipped_bundles() -> Path:
    """Folder of the models that ship with the package."""
    return Path(str(resources.files("model"))) / "bundles"


def open_named(name_or_folder: str) -> ShapeModel:
    """Open a shipped model by name, or a bundle by its folder.

    Raises:
        UnknownModel: neither is there.
        BundleError: it is there and cannot be trusted.
    """
    return open_bundle(find_bundle(name_or_folder, [shipped_bundles()]))


def methods_for(regime: Regime) -> tuple[Method, ...]:
    """What is measured in a regime."""
    match regime:
        case "orthogonal":
            return Method.MODEL, Method.ITK
        case "dense":
            return (Method.MODEL,)
        case _:
            return Method.MODEL, Method.SIGNED_DISTANCE, Method.ITK


def evaluate(
    model: ShapeModel,
    cases: Sequence[Case],
    regimes: Sequence[Regime],
    *,
    offset: int | None = None,
    seed: int = 0,
    watch: Watch = lambda measurement: None,
) -> list[Measurement]:
    """Measure the model and the baselines on every case and regime.

    Args:
        model: an open bundle.
        cases: dense masks that the model was not trained on.
        regimes: in which order.
        offset: see `sparsify.for_evaluation`.
        seed: of the reconstruction.
        watch: called after each measurement.
    """
    fills = fills_of(model, seed)
    found: list[Measurement] = []
    if cases and regimes:
        _warm_up(cases[0], regimes[0], fills)
    for regime in regimes:
        for case in cases:
            drawing = for_evaluation(case.mask, case.grid, regime, offset=offset)
            for method in methods_for(regime):
                found.append(measure(case, regime, drawing, method, fills[method]))
                watch(found[-1])
    return found


def _warm_up(case: Case, regime: Regime, fills: Mapping[Method, Fill]) -> None:
    """Let the libraries load before anything is timed."""
    drawing = for_evaluation(case.mask, case.grid, regime)
    for method in methods_for(regime):
        measure(case, regime, drawing, method, fills[method])


def fills_of(model: ShapeModel, seed: int) -> dict[Method, Fill]:
    """The methods as functions of a drawing and a grid."""

    def with_model(drawing: Drawing, grid: Grid) -> Bool[np.ndarray, "i j k"]:
        options = Options(annotated=drawing.planes, uncertainty="none", seed=seed)
        found = reconstruct(model, [drawing.stack], options)
        return body_mask(model, found.state, found.mesh, grid)

    return {
        Method.MODEL: with_model,
        Method.SIGNED_DISTANCE: lambda drawing, grid: signed_distance_interpolation(
            drawing.stack, drawing.planes, grid
        ),
        Method.ITK: contour_fill,
    }


def reconstruction_error_mm(model: ShapeModel, case: Case, regime: Regime, *, seed: int = 0) -> float:
    """Average surface distance (mm) of the reconstruction of one drawing from the dense mask.

    Raises:
        CohortError: the drawing cannot be reconstructed; names the case.
    """
    with naming(case, regime):
        found = fills_of(model, seed)[Method.MODEL](for_evaluation(case.mask, case.grid, regime), case.grid)
    return agreement(case.mask, found, case.grid.spacing).asd_mm


def measure(case: Case, regime: Regime, drawing: Drawing, method: Method, fill: Fill) -> Measurement:
    """One method on one drawing; a drawing that it cannot take is an answer, not an error."""
    begin = time.perf_counter()
    try:
        filled = fill(drawing, case.grid)
    except InputError as error:
        return Measurement(case.name, regime, method, None, time.perf_counter() - begin, str(error))
    seconds = time.perf_counter() - begin
    return Measurement(case.name, regime, method, agreement(case.mask, filled, case.grid.spacing), seconds)
