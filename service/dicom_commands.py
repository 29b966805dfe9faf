"""The commands ``deidentify`` and ``audit``."""

from pathlib import Path
from typing import Annotated

import typer

from model.errors import InvalidParameter
from service.adapters.image_guard import ImageLimits
from service.adapters.nifti import write_nifti
from service.console import writing
from service.extras import require_extra
from service.settings import load_settings


def deidentify(
    study: Annotated[Path, typer.Argument(help="Folder with the DICOM files of a study.")],
    output: Annotated[Path, typer.Option(help="Folder to write; it must be empty or not there.")],
) -> None:
    """Turn a study into training data: objects without identifiers, and drawings as label maps."""
    require_extra("pacs", needed_by="morphoflow deidentify")
    from service.adapters.dicom import deidentification

    if not study.is_dir():
        raise InvalidParameter("The study must be a folder with DICOM files.", part="study")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InvalidParameter("--output names a folder that is not empty; an empty one is accepted.", part="--output")
    settings = load_settings()
    limits = ImageLimits(max_bytes=settings.max_body_bytes, max_voxels=settings.max_voxels)
    objects = list(deidentification.read_study(study))
    if not objects:
        raise InvalidParameter("The study holds no DICOM file; files with the DICOM prefix are accepted.", part="study")
    maps = list(deidentification.label_maps(objects, limits))
    with writing("--output"):
        for folder in (output / "dicom", output / "masks"):
            folder.mkdir(parents=True)
        for number, found in enumerate(objects):
            path = output / "dicom" / f"{number:06d}.dcm"
            deidentification.without_identifiers(found).save_as(path, enforce_file_format=True)
        for number, drawn in enumerate(maps):
            data = write_nifti(drawn.values, drawn.grid, "drawing")
            (output / "masks" / f"{number:06d}.nii.gz").write_bytes(data)
    typer.echo(f"{len(objects)} objects without identifiers, {len(maps)} drawings as label maps.")


def audit(
    file: Annotated[Path, typer.Argument(help="Audit trail (JSON lines).")],
) -> None:
    """Check that no line of an audit trail was changed, removed or put in between."""
    from service.adapters.pacs.audit import broken_line

    if not file.is_file():
        raise InvalidParameter("The audit trail must be a file; there is none of this name.", part="file")
    number = broken_line(file)
    if number is not None:
        raise InvalidParameter(f"The audit trail is broken at line {number}.", part="file")
    typer.echo("The audit trail is whole.")
