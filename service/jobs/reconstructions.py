"""Reconstruction in the background: one object from its stacks, or every mask of a ZIP or a folder."""

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from model.errors import InputError, InvalidParameter, TooLarge
from service import use_cases
from service.job_files import JobFiles
from service.job_ports import Check, JobKind, JobRun, Record
from service.jobs.tools import JobTools, labels_of, options_of
from service.ports import RECONSTRUCTION_JOB, RECONSTRUCTIONS_JOB, Outcome
from service.presentation import summary_of

#: Files of an archive or a folder with these endings are masks; others are left out.
MASK_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".mha", ".mhd", ".dcm")


def reconstruction_kind(tools: JobTools) -> JobKind:
    """The kind of job behind ``Prefer: respond-async``; its result is kept under the job's own identifier."""

    def follow(run: JobRun, argument: Record) -> Record:
        run.expect(1)
        run.spread("reconstruct", [{**argument, "job": run.id}])
        return {"reconstruction": run.id}

    def reconstruct(item: Record, check: Check) -> Record:
        files = tools.files(item["job"])
        sources = [files.input(number) for number in range(item["masks"])]
        tools.store.save(_reconstruct(tools, item, sources, check), item["job"])
        return {}

    return JobKind(RECONSTRUCTION_JOB, follow, {"reconstruct": reconstruct})


def reconstructions_kind(tools: JobTools) -> JobKind:
    """The kind of job that reconstructs each mask of an archive; one at fault is an entry and stops no other."""

    def follow(run: JobRun, argument: Record) -> Record:
        count = run.spread("unpack", [{"job": run.id}], [0])[0]["count"]
        run.expect(count)
        run.spread("reconstruct", [{**argument, "job": run.id, "number": number} for number in range(count)])
        return {"count": count}

    parts = {
        "unpack": lambda item, _: _unpack(tools, tools.files(item["job"])),
        "reconstruct": lambda item, check: _reconstruct_one(tools, item, check),
    }
    return JobKind(RECONSTRUCTIONS_JOB, follow, parts)


def _unpack(tools: JobTools, files: JobFiles) -> Record:
    """Inputs 1, 2, ... are the masks of the archive that is input 0."""
    names = []
    for name, content in masks_in(files.input(0), tools.max_masks, tools.max_bytes):
        names.append(name)
        files.put_input(len(names), content)
    if not names:
        raise InvalidParameter(
            f"The archive must hold masks; they end with {', '.join(MASK_SUFFIXES)}.", part="archive"
        )
    files.put_note("names", {"names": names})
    model = tools.registry.names()
    files.put_note("manifest", {"kind": RECONSTRUCTIONS_JOB, "unit": "mm", "models": list(model)})
    return {"count": len(names)}


def masks_in(archive: bytes, max_masks: int, max_bytes: int) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the masks in a ZIP, in the order of their names.

    Raises:
        InvalidParameter: not a ZIP, or a damaged one.
        TooLarge: too many masks, or one that is too large.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(archive)) as opened:
            found = sorted((info for info in opened.infolist() if _is_mask(info)), key=lambda info: info.filename)
            if len(found) > max_masks:
                raise TooLarge(f"The archive must not hold more than {max_masks} masks.", part="archive")
            for info in found:
                if info.file_size > max_bytes:
                    raise TooLarge(f"A mask in the archive must not be larger than {max_bytes} bytes.", part="archive")
                yield info.filename, opened.read(info)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError):
        raise InvalidParameter("The part archive must be a ZIP without password.", part="archive") from None


def zip_of_folder(folder: Path) -> bytes:
    """The masks below a folder as a ZIP, under their names relative to it."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.name.lower().endswith(MASK_SUFFIXES) and not path.name.startswith("."):
                archive.write(path, path.relative_to(folder).as_posix())
    return target.getvalue()


def _is_mask(info: zipfile.ZipInfo) -> bool:
    path = PurePosixPath(info.filename)
    hidden = any(part.startswith((".", "__MACOSX")) for part in path.parts)
    return not info.is_dir() and not hidden and path.name.lower().endswith(MASK_SUFFIXES)


def _reconstruct_one(tools: JobTools, item: Record, check: Check) -> Record:
    files, number = tools.files(item["job"]), item["number"]
    if files.has_item(number):
        return {"made": 0}
    check()
    tools.log.debug("item begun", job=item["job"], item=number)
    name = files.note("names")["names"][number]
    try:
        outcome = _reconstruct(tools, item, [files.input(number + 1)], check)
    except InputError as error:
        files.put_item(number, {}, {"mask": name, "problem": str(error)})
    else:
        _put(tools, files, number, name, item["format"], outcome)
    return {"made": 1}


def _put(tools: JobTools, files: JobFiles, number: int, name: str, format: str, outcome: Outcome) -> None:
    metadata = {"model": outcome.model_name, "version": outcome.model_version, "digest": outcome.model_digest}
    answer = outcome.reconstruction
    surface = tools.write_mesh(answer.mesh, format, space=answer.space, metadata=metadata)
    summary = json.loads(summary_of(outcome).model_dump_json())
    file = f"{number:06d}.{format}"
    files.put_item(number, {file: surface}, {"mask": name, "file": file, "summary": summary})


def _reconstruct(tools: JobTools, item: Record, sources: list[bytes], check: Check) -> Outcome:
    labels, options = labels_of(item), options_of(item)
    model = tools.registry.get(item["model"])
    stacks = tuple(
        stack for number, data in enumerate(sources) for stack in tools.read_mask(data, f"mask[{number}]", labels)
    )
    return use_cases.reconstruct(model, stacks, options, tools.max_voxels, check=check)
