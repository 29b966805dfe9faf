"""What a file says of the model that made it."""

from model.bundle import ShapeModel
from service.ports import Outcome


def metadata_of(made: Outcome | ShapeModel) -> dict[str, object]:
    """Name, version and digest of the model of a reconstruction, or of one whose own shape it is."""
    said = named_model(made)
    return {"model": said["name"], "version": said["version"], "digest": said["digest"]}


def named_model(made: Outcome | ShapeModel) -> dict[str, str]:
    """The same as the manifests of archives have it."""
    if isinstance(made, ShapeModel):
        return {"name": made.manifest.name, "version": made.manifest.version, "digest": made.digest}
    return {"name": made.model_name, "version": made.model_version, "digest": made.model_digest}
