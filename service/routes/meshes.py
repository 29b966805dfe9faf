"""Meshes to files, with what a reader should know of them."""

from model.bundle import ShapeModel
from model.geometry import Space
from model.inference.decimation import decimated
from service.ports import MeshFormat, Outcome, StoredResult
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
    return services.write_mesh(mesh, format.value, space=world, metadata=metadata_of_outcome(outcome))


def metadata_of_outcome(outcome: Outcome) -> dict[str, object]:
    """What a mesh says of the model that made it."""
    return {"model": outcome.model_name, "version": outcome.model_version, "digest": outcome.model_digest}


def metadata_of_model(model: ShapeModel) -> dict[str, object]:
    """The same of a shape of the model itself."""
    return {"model": model.manifest.name, "version": model.manifest.version, "digest": model.digest}
