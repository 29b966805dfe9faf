"""Libraries that only some installations have: what needs them is refused in one sentence before it starts."""

import sys
from importlib.util import find_spec

from model.errors import InvalidParameter
from service.settings import Settings

#: Modules that each extra brings and the service imports.
EXTRAS = {
    "cluster": ("boto3", "botocore"),
    "pacs": ("dicomanonymizer", "dicomweb_client", "highdicom", "pydicom", "pynetdicom", "requests"),
}


def install_line(extra: str) -> str:
    """The words for the shell that install an extra, in the folder of the sources."""
    return f"pip install -c constraints.txt '.[{extra}]'"


def require_extra(extra: str, *, needed_by: str) -> None:
    """Refuse what needs an extra that is not installed.

    Raises:
        InvalidParameter: names the extra and says how to install it.
    """
    if any(sys.modules.get(name) is None and find_spec(name) is None for name in EXTRAS[extra]):
        raise InvalidParameter(f"{needed_by} needs the extra {extra}: {install_line(extra)}", part=needed_by)


def require_extras(settings: Settings) -> None:
    """Refuse settings that need extras that are not installed.

    Raises:
        InvalidParameter: see `require_extra`.
    """
    if settings.storage_url:
        require_extra("cluster", needed_by="MORPHOFLOW_STORAGE_URL")
    if settings.pacs_file is not None:
        require_extra("pacs", needed_by="MORPHOFLOW_PACS_FILE")
