"""What tests of the service share: a running server over the analytic model, masks of ellipsoids, outcomes."""

import gzip
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from io import StringIO
from pathlib import Path
from typing import Any

import httpx
import nibabel as nib
import numpy as np
import uvicorn
from fastapi import FastAPI
from jaxtyping import Float
from starlette.types import ASGIApp, Receive, Scope, Send

from model.bundle import ShapeModel
from model.geometry import Grid, Pose
from model.inference.calipers import Extent
from model.inference.estimates import Estimate
from model.inference.fitting import Fit, FitStatus
from model.inference.mesh import Mesh
from model.inference.observations import Plane
from model.inference.reconstruction import Options, PlaneResidual, Reconstruction
from model.inference.uncertainty import ShapeState
from service.app import create_app
from service.model_registry import ModelRegistry
from service.observability import make_log
from service.ports import Outcome
from service.settings import Settings
from tests.analytic_model import MEAN_AXES, EllipsoidDecoder, ellipsoid_model
from tests.analytic_shapes import Ellipsoid

NAME = "ellipsoid"


def settings_for(folder: Path, **changes: Any) -> Settings:
    """Settings that keep results below a test's own folder and load no model from disk."""
    return Settings(**{"results_folder": folder / "results", "shipped_models": False, **changes})


def app_for(folder: Path, *models: ShapeModel, log: StringIO | None = None, **changes: Any) -> FastAPI:
    """The application over the analytic model, or over the models given."""
    loaded = {model.manifest.name: model for model in models or (ellipsoid_model(NAME),)}
    return create_app(
        settings_for(folder, **changes), registry=ModelRegistry(loaded), log=make_log("debug", log or StringIO())
    )


@contextmanager
def running(app: ASGIApp, *, headers: Mapping[str, str] | None = None, root_path: str = "") -> Iterator[httpx.Client]:
    """A client of a real server on a free port of this machine."""
    config = uvicorn.Config(app, host="127.0.0.1", port=0, root_path=root_path, log_config=None, access_log=False)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started and thread.is_alive():
        thread.join(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=headers, timeout=120.0) as client:
            yield client
    finally:
        server.should_exit = True
        thread.join(30.0)


def behind_prefix(app: ASGIApp, prefix: str) -> ASGIApp:
    """The application as a server gives it requests below a prefix that a proxy strips."""

    async def proxied(scope: Scope, receive: Receive, send: Send) -> None:
        await app({**scope, "root_path": prefix} if scope["type"] == "http" else scope, receive, send)

    return proxied


def sparse_ellipsoid(
    axes: tuple[float, float, float] = MEAN_AXES, *, shape: tuple[int, int, int] = (36, 30, 26), every: int = 4
) -> tuple[Float[np.ndarray, "i j k"], Grid]:
    """Values (0, 1) of an ellipsoid in the middle of a 1 mm grid, drawn on every n-th plane of the last axis."""
    affine = np.eye(4)
    affine[:3, 3] = (-40.0, 15.0, 8.0)
    grid = Grid(shape, affine)
    centre = grid.to_world((np.array([shape]) - 1) / 2)[0]
    values = Ellipsoid(axes, centre).mask(grid).astype(np.uint8)
    drawn = np.zeros(shape, np.uint8)
    drawn[:, :, ::every] = values[:, :, ::every]
    return drawn, grid


def nifti_of(values: np.ndarray, grid: Grid) -> bytes:
    """The same as a NIfTI file."""
    return bytes(nib.Nifti1Image(values, grid.affine).to_bytes())


def mask_bytes(axes: tuple[float, float, float] = MEAN_AXES) -> bytes:
    """A sparse ellipsoid as a NIfTI file."""
    return nifti_of(*sparse_ellipsoid(axes))


def mask_parts(*masks: bytes) -> list[tuple[str, tuple[str, bytes]]]:
    """Multipart parts; one ellipsoid when none is given."""
    return [("mask", ("Doe^Jane.nii", data)) for data in masks or (mask_bytes(),)]


def tetrahedron(scalars: Mapping[str, np.ndarray] | None = None) -> Mesh:
    """The smallest closed surface, volume 1/6 mm^3."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    normals = np.array([[-1, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    return Mesh(vertices, faces, normals / np.linalg.norm(normals, axis=1, keepdims=True), dict(scalars or {}))


def outcome_of(model: ShapeModel | None = None, *, uncertain: bool = True, seed: int = 3) -> Outcome:
    """A small outcome with every field filled."""
    chosen = model or ellipsoid_model(NAME)
    rng = np.random.default_rng(seed)
    fits = tuple(
        Fit(
            rng.normal(size=3),
            Pose(rng.normal(size=3)).moved(rng.normal(size=7)),
            status,
            "It ended.",
            4,
            1.5,
            np.eye(10),
        )
        for status in (FitStatus.CONVERGED, FitStatus.STALLED)
    )
    plane = Plane(0, 2, 7)
    interval = (0.9, 1.1) if uncertain else (None, None)
    reconstruction = Reconstruction(
        state=ShapeState(fits, rng.normal(size=(10, 10)) if uncertain else None),
        mesh=tetrahedron({"surface_sd_mm": np.full(4, 0.3)} if uncertain else {}),
        planes=(plane, Plane(0, 1, 2)),
        observation_count=123,
        residuals=(PlaneResidual(plane, 0.1, -0.02),),
        volume_ml=Estimate(1.0, *interval),
        area_cm2=Estimate(2.0, *interval),
        extents=(Extent("R", (1.0, 0.0, 0.0), Estimate(3.0, *interval)),),
        log_prior_density=-3.5,
        typicality_percentile=42.0,
        warnings=("It is small.",),
    )
    manifest = chosen.manifest
    options = Options(annotated=(plane,), uncertainty="laplace" if uncertain else "none", seed=seed)
    grid = Grid((5, 6, 7), np.diag([1.0, 2.0, 3.0, 1.0]))
    return Outcome(manifest.name, manifest.version, chosen.digest, options, grid, reconstruction)


@dataclass(frozen=True)
class GatedDecoder(EllipsoidDecoder):
    """Waits at its first evaluation until the gate opens, so that a test holds a worker busy."""

    gate: threading.Event = field(default_factory=threading.Event)
    entered: threading.Event = field(default_factory=threading.Event)

    def logits(self, latent: Float[np.ndarray, "b 3"], points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n"]:
        """As its parent, once the gate is open."""
        self.entered.set()
        self.gate.wait(60.0)
        return super().logits(latent, points)


def gated_model() -> tuple[ShapeModel, GatedDecoder]:
    """The analytic model behind a gate."""
    decoder = GatedDecoder()
    return replace(ellipsoid_model(NAME), decoder=decoder), decoder


def image(response):
    """The NIfTI file of an answer."""
    assert response.status_code == 200
    return nib.Nifti1Image.from_bytes(gzip.decompress(response.content))


def problem(response, status):
    """What an answer of this status says went wrong."""
    assert response.status_code == status
    assert response.headers["content-type"] == "application/problem+json"
    return response.json()
