"""The commands ``deidentify``, ``audit`` and ``resend``."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from pydantic import BaseModel, Field

from model.errors import InvalidParameter
from service.adapters.image_guard import ImageLimits
from service.adapters.nifti import write_nifti
from service.commands import JsonOption
from service.console import echo_json, writing
from service.extras import require_extra
from service.observability import make_log
from service.settings import load_settings
from service.stores import open_blobs, open_jobs
from service.wiring import image_limits

if TYPE_CHECKING:
    from service.adapters.dicom.deidentification import LabelMap, LeftOut, StudyFile
    from service.adapters.pacs.inbox import Inbox


class LeftOutFile(BaseModel):
    """A file of a study that nothing was made of."""

    file: str = Field(description="Path below the folder of the study.")
    reason: str


class LabelledStructure(BaseModel):
    """A segment or region in a label map."""

    value: int = Field(description="Of its voxels.")
    number: int = Field(description="Segment or ROI number in the drawing.")
    meaning: str = Field(description="Of its code; empty without one.")


class WrittenLabelMap(BaseModel):
    """A label map, and which of its values is which segment or region."""

    file: str = Field(description="Path below the folder that was written.")
    drawing: str = Field(description="Path of the drawing there.")
    structures: list[LabelledStructure]


class DeidentifiedStudy(BaseModel):
    """What became of a study."""

    objects: int = Field(description="Objects without identifiers that were written.")
    label_maps: int = Field(description="Label maps that were written.")
    masks: list[WrittenLabelMap] = Field(description="What the values of each label map are.")
    unused_files: list[LeftOutFile] = Field(description="DICOM files that cannot be used.")
    unused_drawings: list[LeftOutFile] = Field(description="Drawings without a label map.")


def deidentify(
    study: Annotated[Path, typer.Argument(help="Folder with the DICOM files of a study.")],
    output: Annotated[Path, typer.Option(help="Folder to write; it must be empty or not there.")],
    as_json: JsonOption = False,
) -> None:
    """Turn a study into training data: objects without identifiers, and drawings as label maps."""
    require_extra("pacs", needed_by="morphoflow deidentify")
    if not study.is_dir():
        raise InvalidParameter("The study must be a folder with DICOM files.", part="study")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InvalidParameter("--output names a folder that is not empty; an empty one is accepted.", part="--output")
    settings = load_settings()
    limits = image_limits(settings)
    with writing("--output"):
        done = _deidentify(study, output, limits)
    for name, left_out in (("not used", done.unused_files), ("no label map", done.unused_drawings)):
        for item in left_out:
            typer.echo(f"{name}: {item.file}: {item.reason}", err=True)
    if not done.objects:
        raise InvalidParameter(
            "The study holds no DICOM file that can be used; objects with the DICOM prefix, little endian, "
            "uncompressed or RLE, are accepted.",
            part="study",
        )
    echo_json(done) if as_json else typer.echo(_sentence(done))


def _deidentify(study: Path, output: Path, limits: ImageLimits) -> DeidentifiedStudy:
    """Write what can be used; the folder is made with the first object."""
    kept, originals, unused = _write_objects(study, output)
    masks, undrawn = _write_masks(kept, originals, output, limits)
    return DeidentifiedStudy(
        objects=len(kept), label_maps=len(masks), masks=masks, unused_files=unused, unused_drawings=undrawn
    )


def _write_objects(study: Path, output: Path) -> tuple[list["StudyFile"], dict[str, str], list[LeftOutFile]]:
    """Objects by the names that they were written under, those that they had, and the files that were left out."""
    from service.adapters.dicom.deidentification import LeftOut, StudyFile, cleared, read_study, without_pixels

    kept: list[StudyFile] = []
    originals: dict[str, str] = {}
    unused: list[LeftOutFile] = []
    for found in read_study(study):
        data = cleared(found) if isinstance(found, StudyFile) else found
        if isinstance(data, LeftOut):
            unused.append(_schema(data))
        elif isinstance(found, StudyFile):
            name = f"dicom/{len(kept):06d}.dcm"
            _write(output / name, data)
            kept.append(StudyFile(name, without_pixels(found.content)))
            originals[name] = found.name
    return kept, originals, unused


def _write_masks(
    kept: Sequence["StudyFile"], originals: Mapping[str, str], output: Path, limits: ImageLimits
) -> tuple[list[WrittenLabelMap], list[LeftOutFile]]:
    """Label maps of the objects as they were written, so that what refers to what is as in them; drawings without."""
    from service.adapters.dicom.deidentification import LeftOut, label_maps

    masks: list[WrittenLabelMap] = []
    undrawn: list[LeftOutFile] = []
    for drawn in label_maps(kept, limits):
        if isinstance(drawn, LeftOut):
            undrawn.append(LeftOutFile(file=originals[drawn.name], reason=drawn.reason))
        else:
            name = f"masks/{len(masks):06d}.nii.gz"
            _write(output / name, write_nifti(drawn.values, drawn.grid, "drawing"))
            masks.append(_described(drawn, name))
    return masks, undrawn


def _described(drawn: "LabelMap", name: str) -> WrittenLabelMap:
    structures = [LabelledStructure.model_validate(item, from_attributes=True) for item in drawn.structures]
    return WrittenLabelMap(file=name, drawing=drawn.drawing, structures=structures)


def _schema(found: "LeftOut") -> LeftOutFile:
    return LeftOutFile(file=found.name, reason=found.reason)


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _sentence(done: DeidentifiedStudy) -> str:
    left_out = [f"{len(done.unused_files)} files not used"] if done.unused_files else []
    left_out += [f"{len(done.unused_drawings)} drawings without a label map"] if done.unused_drawings else []
    written = f"{done.objects} objects without identifiers, {done.label_maps} label maps of drawings"
    return f"{', '.join([written, *left_out])}."


def audit(
    file: Annotated[Path, typer.Argument(help="Audit trail (JSON lines).")],
) -> None:
    """Check that no line of an audit trail was changed, removed or put in between."""
    from service.adapters.pacs.audit import check_trail

    if not file.is_file():
        raise InvalidParameter("The audit trail must be a file; there is none of this name.", part="file")
    found = check_trail(file)
    if found.torn:
        typer.echo(f"Torn off when a process ended: line {', '.join(map(str, found.torn))}.", err=True)
    if found.broken is not None:
        raise InvalidParameter(f"The audit trail is broken at line {found.broken}.", part="file")
    typer.echo("The audit trail is whole.")


class Resent(BaseModel):
    """What became of drawings in quarantine."""

    taken: list[str] = Field(description="Folders in quarantine whose drawings are worked on again.")
    left: list[str] = Field(description="Folders whose objects no rule takes, or that cannot be read; they stay.")


def resend(
    names: Annotated[list[str] | None, typer.Argument(help="Folders in quarantine; all when left out.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Take drawings in quarantine up again, so that archives are sent the results that they lack."""
    require_extra("pacs", needed_by="morphoflow resend")
    from service.pacs import open_pacs

    settings = load_settings()
    if settings.pacs_file is None:
        raise InvalidParameter("MORPHOFLOW_PACS_FILE must name the file of rules.", part="pacs_file")
    log = make_log("error")
    with closing(open_jobs(settings)) as jobs:
        done = _resend(open_pacs(settings, settings.pacs_file, open_blobs(settings), jobs, log).inbox, names)
    echo_json(done) if as_json else typer.echo(f"Taken up again: {len(done.taken)}; left: {len(done.left)}.")


def _resend(inbox: "Inbox", names: list[str] | None) -> Resent:
    there = inbox.in_quarantine()
    unknown = sorted(set(names or ()) - set(there))
    if unknown:
        raise InvalidParameter(
            f"The quarantine has no folder {unknown[0]}; names of folders in it are accepted.", part="NAME"
        )
    done = Resent(taken=[], left=[])
    for name in sorted(set(names)) if names else there:
        (done.taken if _is_taken(inbox, name) else done.left).append(name)
    return done


def _is_taken(inbox: "Inbox", name: str) -> bool:
    """Send one again; it is gone where another structure of the same object was sent again before."""
    from service.pacs_ports import Disposition

    try:
        return inbox.send_again(name) is Disposition.ACCEPTED
    except FileNotFoundError:
        return True
