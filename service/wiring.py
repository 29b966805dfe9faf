"""What the service, its workers and its commands are wired with alike."""

from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed_version

from service.adapters.images import ImageLimits, read_masks
from service.ports import MaskReader
from service.settings import Settings


def image_limits(settings: Settings) -> ImageLimits:
    """What an image may cost."""
    return ImageLimits(max_bytes=settings.max_body_bytes, max_voxels=settings.max_voxels)


def mask_reader(settings: Settings) -> MaskReader:
    """The reader of masks with the limits of the settings."""
    limits = image_limits(settings)
    return lambda data, part, labels: read_masks(data, part, limits, labels)


def program_version() -> str:
    """Version of the installed program."""
    try:
        return installed_version("morphoflow")
    except PackageNotFoundError:
        return "0+unknown"
