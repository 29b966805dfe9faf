"""What the interface's description says of answers: files, and problems by status."""

from collections.abc import Iterable
from typing import Any

from service.errors import KINDS, PROTOCOL_KINDS
from service.ports import MeshFormat, SampleFormat
from service.routes.problems import PROBLEM_MEDIA_TYPE

JSON = "application/json"
ZIP = "application/zip"
NIFTI = "application/gzip"
NPZ = "application/x-npz"
#: Media type of each mesh format, in the order of preference among equals.
MESH_MEDIA_TYPES: dict[MeshFormat, str] = {
    MeshFormat.PLY: "application/x-ply",
    MeshFormat.STL: "model/stl",
    MeshFormat.OBJ: "model/obj",
    MeshFormat.GLB: "model/gltf-binary",
    MeshFormat.THREE_MF: "model/3mf",
    MeshFormat.VTP: "application/vnd.vtk.polydata+xml",
    MeshFormat.MZ3: "application/x-mz3",
}
#: Mesh formats that a reconstruction request can be answered with.
DIRECT_FORMATS = (MeshFormat.PLY, MeshFormat.STL, MeshFormat.OBJ, MeshFormat.GLB, MeshFormat.THREE_MF)

Responses = dict[int | str, dict[str, Any]]


def sample_media_type(format: SampleFormat) -> str:
    """Media type of a synthetic shape's file."""
    other = {SampleFormat.NIFTI: NIFTI, SampleFormat.NPZ: NPZ, SampleFormat.PAIRS: NPZ}
    return other[format] if format in other else MESH_MEDIA_TYPES[MeshFormat(format.value)]


def files(media_types: Iterable[str], description: str) -> dict[str, Any]:
    """Description of an answer that is a file."""
    binary = {"type": "string", "format": "binary"}
    return {"description": description, "content": {media: {"schema": binary} for media in sorted(set(media_types))}}


def problems(*statuses: int) -> Responses:
    """Description of the problems that a route may answer with, 401 and 500 among them."""
    return {status: _problem(status) for status in sorted({401, 500, *statuses})}


def _problem(status: int) -> dict[str, Any]:
    kinds = {kind.type: kind.title for kind in (*KINDS.values(), *PROTOCOL_KINDS.values()) if kind.status == status}
    schema = {"$ref": "#/components/schemas/Problem"}
    description = "; ".join(f"`{name}` {title}" for name, title in kinds.items())
    answer: dict[str, Any] = {"description": description, "content": {PROBLEM_MEDIA_TYPE: {"schema": schema}}}
    if status == 503:
        answer["headers"] = {"Retry-After": {"schema": {"type": "integer"}, "description": "seconds to wait"}}
    return answer


def attachment(name: str) -> dict[str, str]:
    """Header that names a file."""
    return {"Content-Disposition": f'attachment; filename="{name}"'}
