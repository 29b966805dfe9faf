"""Meshes to files, with what a reader should know of them."""

from model.geometry import Space
from model.inference.decimation import decimated
from service.ports import MeshFormat, StoredResult
from service.routes.dependencies import Services


def mesh_bytes(
    services: Services,
    result: StoredResult,
    format: MeshFormat,
    max_error_mm: float = 0.0,
    space: Space | None = None,
) -> bytes:
    """A result's surface, of fewer triangles where it may be that far (mm) from the full one.

    Args:
        space: of the coordinates; the input's world when None.
    """
    outcome = result.outcome
    metadata = model_metadata(outcome.model_name, outcome.model_version, outcome.model_digest)
    mesh = decimated(outcome.reconstruction.mesh, max_error_mm)
    return services.write_mesh(mesh, format.value, space=space or outcome.reconstruction.space, metadata=metadata)


def model_metadata(name: str, version: str, digest: str) -> dict[str, object]:
    """What a mesh says of the model that made it."""
    return {"model": name, "version": version, "digest": digest}
