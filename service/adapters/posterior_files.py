"""Shapes from the posterior of a reconstruction as files, and the manifest that goes with them."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from model.geometry import Space
from model.inference.mesh import area_cm2, volume_ml
from model.inference.posterior_shapes import PosteriorShape
from service.adapters.sample_files import SampleFile
from service.ports import MeshFormat, MeshWriter
from service.provenance import metadata_of, named_model
from service.use_cases import Posterior


class PosteriorWriter:
    """Draws shapes and writes them in a mesh format."""

    def __init__(self, write_mesh: MeshWriter, format: MeshFormat) -> None:
        self._write_mesh = write_mesh
        self._format = format

    def make(self, posterior: Posterior, seed: int) -> SampleFile:
        """The shape of a seed; the same arguments give the same bytes.

        A draw without any surface is an entry without a file, and has no bytes.
        """
        shape = posterior.draw(seed)
        if shape.mesh.is_empty:
            return SampleFile("", b"", {"file": None, **_entry(shape, seed)})
        name = f"posterior-{seed}.{self._format.value}"
        said = {**metadata_of(posterior.outcome), "seed": seed}
        data = self._write_mesh(shape.mesh, self._format.value, space=_space(posterior), metadata=said)
        return SampleFile(name, data, {"file": name, **_entry(shape, seed)})

    def manifest(self, posterior: Posterior, identifier: str, entries: Sequence[dict[str, Any]]) -> bytes:
        """``manifest.json`` of a batch."""
        document = {
            "model": named_model(posterior.outcome),
            "reconstruction": identifier,
            "uncertainty": posterior.outcome.options.uncertainty,
            **_members(posterior),
            "space": _space(posterior),
            "unit": "mm",
            "format": self._format.value,
            "spacing_mm": posterior.spacing_mm or posterior.model.manifest.resolution_mm,
            "samples": list(entries),
        }
        return json.dumps(document, indent=1).encode()


def _members(posterior: Posterior) -> dict[str, int]:
    """How many different draws there are, where they are the members of an ensemble."""
    count = len(posterior.outcome.reconstruction.state.members)
    return {"members": count} if count else {}


def _space(posterior: Posterior) -> Space:
    return posterior.outcome.reconstruction.space


def _entry(shape: PosteriorShape, seed: int) -> dict[str, Any]:
    mesh = shape.mesh
    lower, upper = (mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) if len(mesh.vertices) else (np.zeros(3),) * 2
    return {
        "seed": seed,
        "volume_ml": volume_ml(mesh),
        "area_cm2": area_cm2(mesh),
        "extent_mm": (upper - lower).tolist(),
        "latent": shape.fit.latent.tolist(),
    }
