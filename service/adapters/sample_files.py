"""Synthetic shapes as files, and the manifest that goes with a batch of them."""

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.bundle import ShapeModel
from model.inference.sampling import SampledShape
from service import use_cases
from service.ports import MeshWriter, SampleFormat, VolumeWriter

MANIFEST = "manifest.json"
#: Cubic millimetres in a millilitre.
_MM3_PER_ML = 1000.0


@dataclass(frozen=True)
class Draw:
    """Which shape to draw, and how finely.

    Attributes:
        temperature: spread of the latent codes; 1 is the population's.
        spacing_mm: grid step; the model's own when None.
        max_voxels: of any grid that is made on the way.
    """

    format: SampleFormat
    temperature: float
    spacing_mm: float | None
    max_voxels: int


@dataclass(frozen=True)
class SampleFile:
    """One shape as a file, with its entry in a manifest."""

    name: str
    data: bytes
    entry: dict[str, Any]


class SampleWriter:
    """Draws shapes and writes them in the formats of the interface."""

    def __init__(self, write_mesh: MeshWriter, write_volume: VolumeWriter) -> None:
        self._write_mesh = write_mesh
        self._write_volume = write_volume

    def make(self, model: ShapeModel, seed: int, how: Draw) -> SampleFile:
        """The shape of a seed; the same arguments give the same bytes.

        Raises:
            InvalidParameter: temperature or spacing out of its range.
            TooLarge: a grid of more voxels than allowed.
        """
        shape = use_cases.draw(model, seed, how.temperature, how.spacing_mm, how.max_voxels)
        name = f"{model.manifest.name}-{seed}.{suffix(how.format)}"
        return SampleFile(name, self._encode(model, shape, seed, how), _entry(name, shape, seed))

    def _encode(self, model: ShapeModel, shape: SampledShape, seed: int, how: Draw) -> bytes:
        if how.format == SampleFormat.NPZ:
            return _arrays(shape)
        if how.format == SampleFormat.NIFTI:
            spacing = how.spacing_mm or model.manifest.resolution_mm
            volume = use_cases.label_map(model, shape, spacing, how.max_voxels)
            return self._write_volume(volume.array, volume.grid, "synthetic shape")
        return self._write_mesh(
            shape.mesh, how.format.value, space=model.manifest.frame, metadata={**provenance(model), "seed": seed}
        )


def suffix(format: SampleFormat) -> str:
    """File suffix of a format, without the leading dot."""
    return "nii.gz" if format == SampleFormat.NIFTI else format.value


def provenance(model: ShapeModel) -> dict[str, object]:
    """What a file says of the model that made it."""
    return {"model": model.manifest.name, "version": model.manifest.version, "digest": model.digest}


def manifest_bytes(model: ShapeModel, how: Draw, entries: Sequence[dict[str, Any]]) -> bytes:
    """``manifest.json`` of a batch."""
    manifest = model.manifest
    document = {
        "model": {"name": manifest.name, "version": manifest.version, "digest": model.digest},
        "space": manifest.frame,
        "unit": manifest.units,
        "format": how.format.value,
        "temperature": how.temperature,
        "spacing_mm": how.spacing_mm or manifest.resolution_mm,
        "licence": manifest.licence,
        "attribution": manifest.attribution,
        "samples": list(entries),
    }
    return json.dumps(document, indent=1).encode()


def _entry(name: str, shape: SampledShape, seed: int) -> dict[str, Any]:
    return {
        "file": name,
        "seed": seed,
        "latent": shape.latent.tolist(),
        "log_density_nats": float(shape.log_density),
        "volume_ml": _volume_ml(shape),
        "nearest_training_distance": float(shape.nearest_training_distance),
    }


def _volume_ml(shape: SampledShape) -> float:
    corners = shape.mesh.vertices[shape.mesh.faces]
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0 / _MM3_PER_ML)


def _arrays(shape: SampledShape) -> bytes:
    buffer = io.BytesIO()
    np.savez(
        buffer,
        allow_pickle=False,
        latent=shape.latent,
        vertices=shape.mesh.vertices,
        faces=shape.mesh.faces,
        normals=shape.mesh.normals,
    )
    return buffer.getvalue()
