"""Meshes to files, with what a reader should know of them."""

from service.ports import MeshFormat, StoredResult
from service.routes.dependencies import Services


def mesh_bytes(services: Services, result: StoredResult, format: MeshFormat) -> bytes:
    """A result's surface in the input's world."""
    outcome = result.outcome
    metadata = model_metadata(outcome.model_name, outcome.model_version, outcome.model_digest)
    return services.write_mesh(outcome.reconstruction.mesh, format.value, space="RAS", metadata=metadata)


def model_metadata(name: str, version: str, digest: str) -> dict[str, object]:
    """What a mesh says of the model that made it."""
    return {"model": name, "version": version, "digest": digest}
