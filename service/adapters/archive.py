"""An outcome as files of one folder, and back: ``summary.json``, ``state.npz`` and ``mesh.npz``.

Arrays are stored exactly and without pickling; everything else is JSON.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from model.geometry import CanonicalLattice, Grid, Pose
from model.inference.calipers import Extent
from model.inference.completion.field import Completion
from model.inference.discrepancy.covariance import Covariance
from model.inference.discrepancy.levels import Levels
from model.inference.discrepancy.process import Discrepancy
from model.inference.estimates import Estimate
from model.inference.fitting import Fit, FitStatus
from model.inference.mesh import Mesh
from model.inference.observations import Plane
from model.inference.reconstruction import Options, PlaneResidual, Reconstruction
from model.inference.uncertainty import ShapeState
from service.ports import Outcome
from service.provenance import named_model

SUMMARY, STATE, MESH = "summary.json", "state.npz", "mesh.npz"
#: Format of the folder; other ones are not read.
ARCHIVE_VERSION = 2


def write_outcome(folder: Path, outcome: Outcome, times: Mapping[str, float]) -> None:
    """Write an outcome, with the times of its life (s since 1970), into an existing folder."""
    np.savez(folder / STATE, allow_pickle=False, **_state_arrays(outcome.reconstruction.state))
    # Coordinates hardly shrink, and compressing them takes longer than all else here.
    np.savez(folder / MESH, allow_pickle=False, **_mesh_arrays(outcome.reconstruction.mesh))
    document = {"archive": ARCHIVE_VERSION, **times, **_document(outcome)}
    (folder / SUMMARY).write_text(json.dumps(document), encoding="utf-8")


def read_document(folder: Path) -> dict[str, Any]:
    """``summary.json`` of a folder.

    Raises:
        OSError, ValueError: it is not there or not of this format.
    """
    return parse_document((folder / SUMMARY).read_bytes())


def parse_document(content: bytes) -> dict[str, Any]:
    """The document of such a file, with the times of the result's life.

    Raises:
        ValueError: it is not of this format.
    """
    try:
        document: dict[str, Any] = json.loads(content)
        version, _ = document["archive"], [moment(document[name]) for name in ("created", "expires")]
    except (LookupError, TypeError, OverflowError, OSError, RecursionError) as fault:
        raise ValueError("no document of a result") from fault
    if version != ARCHIVE_VERSION:
        raise ValueError("written in another format")
    return document


def moment(seconds: float) -> datetime:
    """Seconds since 1970 as a time of day."""
    return datetime.fromtimestamp(seconds, UTC)


def read_outcome(folder: Path, document: dict[str, Any]) -> Outcome:
    """The outcome that `write_outcome` wrote.

    Raises:
        OSError, ValueError: a file is missing or damaged.
    """
    try:
        return _outcome(folder, document)
    except (OSError, MemoryError):
        raise
    except Exception as fault:
        raise ValueError("damaged") from fault  # libraries stumble over damaged files in many ways


def _outcome(folder: Path, document: dict[str, Any]) -> Outcome:
    state, mesh = _state(_arrays(folder / STATE), document["fits"]), _mesh(_arrays(folder / MESH))
    answer = document["reconstruction"]
    reconstruction = Reconstruction(
        state=state,
        mesh=mesh,
        planes=tuple(Plane(**plane) for plane in answer["planes"]),
        observation_count=answer["observation_count"],
        residuals=tuple(
            PlaneResidual(Plane(**r["plane"]), r["disagreement"], r["mean_error"], r["predictive_p"])
            for r in answer["residuals"]
        ),
        volume_ml=Estimate(**answer["volume_ml"]),
        area_cm2=Estimate(**answer["area_cm2"]),
        extents=tuple(map(_extent, answer["extents"])),
        log_prior_density=answer["log_prior_density"],
        typicality_percentile=answer["typicality_percentile"],
        warnings=tuple(answer["warnings"]),
        space=answer.get("space", "RAS"),
    )
    grid = Grid(tuple(document["grid"]["shape"]), np.array(document["grid"]["affine"]))
    model = document["model"]
    return Outcome(
        model["name"], model["version"], model["digest"], _options(document["options"]), grid, reconstruction
    )


def _arrays(path: Path) -> dict[str, np.ndarray]:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:  # else damage leaves the file open
        return dict(arrays)


def _document(outcome: Outcome) -> dict[str, Any]:
    answer = outcome.reconstruction
    return {
        "model": named_model(outcome),
        "options": asdict(outcome.options),
        "grid": {"shape": list(map(int, outcome.grid.shape)), "affine": outcome.grid.affine.tolist()},
        "fits": [_fit_document(fit) for fit in answer.state.fits],
        "reconstruction": {
            "planes": [_plane(plane) for plane in answer.planes],
            "observation_count": int(answer.observation_count),
            "residuals": [
                {
                    "plane": _plane(r.plane),
                    "disagreement": float(r.disagreement),
                    "mean_error": float(r.mean_error),
                    "predictive_p": r.predictive_p,
                }
                for r in answer.residuals
            ],
            "volume_ml": _estimate(answer.volume_ml),
            "area_cm2": _estimate(answer.area_cm2),
            "extents": [{**asdict(extent), "extent_mm": _estimate(extent.extent_mm)} for extent in answer.extents],
            "log_prior_density": float(answer.log_prior_density),
            "typicality_percentile": float(answer.typicality_percentile),
            "warnings": list(answer.warnings),
            "space": answer.space,
        },
    }


def _plane(plane: Plane) -> dict[str, int]:
    return {"stack": int(plane.stack), "axis": int(plane.axis), "index": int(plane.index)}


def _estimate(estimate: Estimate) -> dict[str, float | None]:
    return {name: None if value is None else float(value) for name, value in asdict(estimate).items()}


def _extent(document: dict[str, Any]) -> Extent:
    x, y, z = document["direction"]
    return Extent(document["along"], (x, y, z), Estimate(**document["extent_mm"]))


def _options(document: dict[str, Any]) -> Options:
    annotated = document["annotated"]
    planes = annotated if isinstance(annotated, str) else tuple(Plane(**plane) for plane in annotated)
    return Options(**{**document, "annotated": planes, "extents": tuple(document["extents"])})


def _fit_document(fit: Fit) -> dict[str, Any]:
    return {
        "status": fit.status.value,
        "message": fit.message,
        "iterations": int(fit.iterations),
        "objective": float(fit.objective),
        "log_scale": float(fit.pose.log_scale),
        "mirrored": bool(fit.pose.mirrored),
    }


def _state_arrays(state: ShapeState) -> dict[str, np.ndarray]:
    arrays = {
        "latent": np.stack([fit.latent for fit in state.fits]),
        "position": np.stack([fit.pose.position for fit in state.fits]),
        "rotation": np.stack([fit.pose.rotation for fit in state.fits]),
        "precision": np.stack([fit.precision for fit in state.fits]),
    }
    for number, fit in enumerate(state.fits):
        arrays |= {
            f"discrepancy_{number}_{name}": values for name, values in _discrepancy_arrays(fit.discrepancy).items()
        }
    arrays |= _completion_arrays(state)
    return arrays if state.covariance is None else {**arrays, "covariance": state.covariance}


def _completion_arrays(state: ShapeState) -> dict[str, np.ndarray]:
    """What a network made of the drawing; members of an ensemble have it in common."""
    discrepancy = state.fits[0].discrepancy
    completion = None if discrepancy is None else discrepancy.levels.completion
    if completion is None:
        return {}
    return {"completion_shifts": completion.shifts, "completion_step": np.array(completion.lattice.step_mm)}


def _completion(arrays: Mapping[str, np.ndarray]) -> Completion | None:
    if "completion_shifts" not in arrays:
        return None
    shifts = arrays["completion_shifts"]
    i, j, k = shifts.shape
    return Completion(CanonicalLattice((i, j, k), float(arrays["completion_step"])), shifts)


def _discrepancy_arrays(discrepancy: Discrepancy | None) -> dict[str, np.ndarray]:
    if discrepancy is None:
        return {}
    return {
        "points": discrepancy.points,
        "residuals": discrepancy.residuals,
        "jacobian": discrepancy.jacobian,
        "terms": np.array([discrepancy.covariance.sds, discrepancy.covariance.lengths]),
        "scales": np.array([discrepancy.noise_mm, discrepancy.slope]),
        "half_extent": discrepancy.half_extent,
    }


def _discrepancy(arrays: Mapping[str, np.ndarray], number: int, completion: Completion | None) -> Discrepancy | None:
    prefix = f"discrepancy_{number}_"
    found = {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
    if not found:
        return None
    sds, lengths = (tuple(map(float, row)) for row in found["terms"])
    noise, slope = map(float, found["scales"])
    places = found["points"], found["residuals"], found["jacobian"]
    levels = Levels(slope, completion)
    return Discrepancy(*places, Covariance(sds, lengths), noise, levels, found["half_extent"])


def _state(arrays: dict[str, np.ndarray], documents: list[dict[str, Any]]) -> ShapeState:
    completion = _completion(arrays)
    fits = tuple(
        Fit(
            latent=arrays["latent"][i],
            pose=Pose(arrays["position"][i], arrays["rotation"][i], document["log_scale"], document["mirrored"]),
            status=FitStatus(document["status"]),
            message=document["message"],
            iterations=document["iterations"],
            objective=document["objective"],
            precision=arrays["precision"][i],
            discrepancy=_discrepancy(arrays, i, completion),
        )
        for i, document in enumerate(documents)
    )
    return ShapeState(fits, arrays.get("covariance"))


def _mesh_arrays(mesh: Mesh) -> dict[str, np.ndarray]:
    scalars = {f"scalar_{name}": values for name, values in mesh.scalars.items()}
    return {"vertices": mesh.vertices, "faces": mesh.faces.astype(np.int32), "normals": mesh.normals, **scalars}


def _mesh(arrays: dict[str, np.ndarray]) -> Mesh:
    scalars = {name.removeprefix("scalar_"): values for name, values in arrays.items() if name.startswith("scalar_")}
    return Mesh(arrays["vertices"], arrays["faces"].astype(np.int64), arrays["normals"], scalars)
