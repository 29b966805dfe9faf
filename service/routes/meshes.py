"""Meshes to files, with what a reader should know of them."""

from model.geometry import Space
from model.inference.decimation import decimated
from service.ports import MeshFormat, StoredResult
from service.provenance import metadata_of
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
    mesh, world = decimated(outcome.reconstruction.mesh, max_error_mm), space or outcome.reconstruction.space
    return services.write_mesh(mesh, format.value, space=world, metadata=metadata_of(outcome))
