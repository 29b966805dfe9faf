"""Reconstruction in the background: one object from its stacks, or every mask of a ZIP or a folder."""

import io
import json

from model.errors import InputError, InvalidParameter
from service import use_cases
from service.errors import kind_of
from service.job_archives import MASK_SUFFIXES, left_out, masks_in
from service.job_files import JobFiles
from service.job_ports import Check, JobKind, JobRun, Record
from service.job_submission import SUBMISSION
from service.jobs.tools import JobTools, labels_of, options_of
from service.ports import RECONSTRUCTION_JOB, RECONSTRUCTIONS_JOB, Outcome
from service.presentation import summary_of
from service.provenance import metadata_of

#: Choices of a job that are longer than this (characters of JSON) are kept once, in a note, and not with each part.
BRIEF = 2048
#: The note, and the member of the answer to `unpack` that says that there is one.
_CHOICES = "choices"


def reconstruction_kind(tools: JobTools) -> JobKind:
    """The kind of job behind ``Prefer: respond-async``; its result is kept under the job's own identifier."""

    def follow(run: JobRun, argument: Record) -> Record:
        run.expect(1)
        run.spread("reconstruct", [{**argument, "job": run.id}])
        return {"reconstruction": run.id}

    def reconstruct(item: Record, check: Check) -> Record:
        files = tools.files(item["job"])
        sources = [files.input(number, item.get(SUBMISSION, "")) for number in range(item["masks"])]
        tools.store.save(_reconstruct(tools, item, sources, check), item["job"])
        return {}

    return JobKind(RECONSTRUCTION_JOB, follow, {"reconstruct": reconstruct}, tools.forget)


def reconstructions_kind(tools: JobTools) -> JobKind:
    """The kind of job that reconstructs each mask of an archive; one at fault is an entry and stops no other."""

    def follow(run: JobRun, argument: Record) -> Record:
        unpacked = run.spread("unpack", [{**argument, "job": run.id}], [0])[0]
        count, shared = unpacked["count"], {} if unpacked.get(_CHOICES) else argument
        run.expect(count)
        run.spread("reconstruct", [{**shared, "job": run.id, "number": number} for number in range(count)])
        return {"count": count}

    parts = {
        "unpack": lambda item, check: _unpack(tools, item, check),
        "reconstruct": lambda item, check: _reconstruct_one(tools, item, check),
    }
    return JobKind(RECONSTRUCTIONS_JOB, follow, parts, tools.forget)


def _unpack(tools: JobTools, item: Record, check: Check) -> Record:
    """Inputs 1, 2, ... are the masks of the archive that is input 0; one that cannot be unpacked is an item already."""
    files, names = tools.files(item["job"]), []
    archive = io.BytesIO(files.input(0, item.get(SUBMISSION, "")))
    for mask in masks_in(archive, tools.archive_limits):
        check()
        names.append(mask.name)
        if mask.problem is None:
            files.put_input(len(names), mask.content)
        else:
            files.put_item(len(names) - 1, {}, _refused(mask.name, mask.problem))
    if not names:
        raise InvalidParameter(
            f"The archive must hold masks; they end with {', '.join(MASK_SUFFIXES)}.", part="archive"
        )
    files.put_note("names", {"names": names})
    known = {"kind": RECONSTRUCTIONS_JOB, "unit": "mm", "models": [item["model"]]}
    files.put_note("manifest", {**known, "left_out": left_out(archive, tools.archive_limits)})
    return {"count": len(names), **_noted(files, item)}


def _noted(files: JobFiles, item: Record) -> Record:
    """Choices that are too long to go with each part as a note; what `unpack` answers of it."""
    if len(json.dumps(item)) <= BRIEF:
        return {}
    files.put_note(_CHOICES, item)
    return {_CHOICES: True}


def _reconstruct_one(tools: JobTools, item: Record, check: Check) -> Record:
    files, number = tools.files(item["job"]), item["number"]
    if files.has_item(number):
        return {"made": 0}
    check()
    tools.log.debug("item begun", job=item["job"], item=number)
    name = files.note("names")["names"][number]
    asked = item if "annotated" in item else files.note(_CHOICES)
    try:
        outcome = _reconstruct(tools, asked, [files.input(number + 1)], check)
    except InputError as error:
        files.put_item(number, {}, _refused(name, error))
    else:
        _put(tools, files, number, name, asked["format"], outcome)
    return {"made": 1}


def _refused(name: str, error: InputError) -> Record:
    """The entry of a mask at fault."""
    return {"mask": name, "problem": str(error), "problem_type": kind_of(error).type}


def _put(tools: JobTools, files: JobFiles, number: int, name: str, format: str, outcome: Outcome) -> None:
    answer = outcome.reconstruction
    surface = tools.write_mesh(answer.mesh, format, space=answer.space, metadata=metadata_of(outcome))
    summary = json.loads(summary_of(outcome).model_dump_json())
    file = f"{number:06d}.{format}"
    files.put_item(number, {file: surface}, {"mask": name, "file": file, "summary": summary})


def _reconstruct(tools: JobTools, item: Record, sources: list[bytes], check: Check) -> Outcome:
    labels, options = labels_of(item), options_of(item)
    model = tools.registry.get(item["model"])
    stacks = use_cases.stacks_of(tools.read_mask, sources, labels, tools.max_voxels, check)
    return use_cases.reconstruct(model, stacks, options, tools.max_voxels, check=check)
