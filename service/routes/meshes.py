"""Meshes to files, with what a reader should know of them."""

from model.inference.decimation import decimated
from service.ports import MeshFormat, StoredResult
from service.routes.dependencies import Services


def mesh_bytes(services: Services, result: StoredResult, format: MeshFormat, max_error_mm: float = 0.0) -> bytes:
    """A result's surface in the input's world, of fewer triangles where it may be that far (mm) from the full one."""
    outcome = result.outcome
    metadata = model_metadata(outcome.model_name, outcome.model_version, outcome.model_digest)
    mesh = decimated(outcome.reconstruction.mesh, max_error_mm)
    return services.write_mesh(mesh, format.value, space="RAS", metadata=metadata)


def model_metadata(name: str, version: str, digest: str) -> dict[str, object]:
    """What a mesh says of the model that made it."""
    return {"model": name, "version": version, "digest": digest}
