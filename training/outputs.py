"""Files that commands write: what is there is not written over unasked."""

from pathlib import Path
from typing import Annotated

import typer

from model.errors import InvalidParameter
from training.console import check_output

ForceOption = Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")]


def check_new_files(*paths: Path, force: bool) -> None:
    """Whether files can be written there and none is lost, told before the work.

    Raises:
        InvalidParameter: something is in the way, or a file is there and `force` is off.
    """
    for path in paths:
        check_output(path, is_folder=False)
    there = next((path for path in paths if path.exists()), None)
    if there is not None and not force:
        raise InvalidParameter(f"The file {there} exists; another name, or --force, is accepted.", part="output")
