"""Synthetic shapes as files, and the manifest that goes with a batch of them."""

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.bundle import ShapeModel
from model.inference.mesh import volume_ml
from model.inference.plausibility import volume_range_ml
from model.inference.reconstruction import Watch
from model.inference.sampling import SampledShape
from model.inference.training_pairs import training_pair
from model.interruption import Check, interruptible
from service import use_cases
from service.job_results import counts_of
from service.ports import MeshWriter, SampleFormat, VolumeWriter
from service.provenance import metadata_of, named_model

MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Draw:
    """Which shape to draw, and how finely.

    Attributes:
        temperature: spread of the latent codes; 1 is the population's.
        spacing_mm: grid step; the model's own when None.
        max_voxels: of any grid that is made on the way.
        reject: draw anew where a shape is implausible.
    """

    format: SampleFormat
    temperature: float
    spacing_mm: float | None
    max_voxels: int
    reject: bool = True


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
        shape = use_cases.draw(model, seed, how.temperature, how.spacing_mm, how.max_voxels, reject=how.reject)
        name = f"{model.manifest.name}-{seed}.{suffix(how.format)}"
        data, more = self._encode(model, shape, seed, how)
        return SampleFile(name, data, {**_entry(name, shape, seed), **more})

    def _encode(self, model: ShapeModel, shape: SampledShape, seed: int, how: Draw) -> tuple[bytes, dict[str, Any]]:
        """The bytes of a file, and what its entry says beyond that of others."""
        match how.format:
            case SampleFormat.NPZ:
                return _arrays(shape), {}
            case SampleFormat.NIFTI:
                volume = _label_map(model, shape, how)
                return self._write_volume(volume.array, volume.grid, "synthetic shape"), {}
            case SampleFormat.PAIRS:
                return _pair(_label_map(model, shape, how), seed)
        said = {**metadata_of(model), "seed": seed}
        return self._write_mesh(shape.mesh, how.format.value, space=model.manifest.frame, metadata=said), {}


def make_sample(
    model: ShapeModel, writer: SampleWriter, seed: int, how: Draw, *, watch: Watch, check: Check
) -> SampleFile:
    """`SampleWriter.make` as a `Compute` calls it."""
    watch("sampling")
    return writer.make(interruptible(model, check), seed, how)


def _label_map(model: ShapeModel, shape: SampledShape, how: Draw) -> use_cases.Volume:
    return use_cases.label_map(model, shape, how.spacing_mm or model.manifest.resolution_mm, how.max_voxels)


def _pair(volume: use_cases.Volume, seed: int) -> tuple[bytes, dict[str, Any]]:
    pair = training_pair(volume.array.astype(np.uint8), seed)
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        allow_pickle=False,
        dense=pair.dense,
        sparse=pair.sparse,
        affine=volume.grid.affine,
        planes=np.array(pair.planes, np.int64).reshape(-1, 2),
    )
    return buffer.getvalue(), {"planes": [{"axis": axis, "index": index} for axis, index in pair.planes]}


def suffix(format: SampleFormat) -> str:
    """File suffix of a format, without the leading dot."""
    special = {SampleFormat.NIFTI: "nii.gz", SampleFormat.PAIRS: "npz"}
    return special.get(format, format.value)


def manifest_bytes(model: ShapeModel, how: Draw, entries: Sequence[dict[str, Any]]) -> bytes:
    """``manifest.json`` of a batch."""
    manifest = model.manifest
    document = {
        "model": named_model(model),
        "space": manifest.frame,
        "unit": manifest.units,
        "format": how.format.value,
        "temperature": how.temperature,
        "spacing_mm": how.spacing_mm or manifest.resolution_mm,
        "licence": manifest.licence,
        "attribution": manifest.attribution,
        "reject": how.reject,
        "volume_range_ml": list(volume_range_ml(model)),
        **counts_of(entries),
        "samples": list(entries),
    }
    return json.dumps(document, indent=1).encode()


def _entry(name: str, shape: SampledShape, seed: int) -> dict[str, Any]:
    return {
        "file": name,
        "seed": seed,
        "latent": shape.latent.tolist(),
        "log_density_nats": float(shape.log_density),
        "volume_ml": volume_ml(shape.mesh),
        "nearest_training_distance": float(shape.nearest_training_distance),
        "rejected": dict(shape.rejected),
        "plausible": shape.plausible,
    }


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
