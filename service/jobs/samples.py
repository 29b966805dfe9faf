"""Bulk sampling: thousands of synthetic shapes, each a pure function of model, seed and query."""

import json
import math
from collections.abc import Mapping
from typing import Any

from model.interruption import interruptible
from service.adapters.sample_files import Draw, SampleWriter, manifest_bytes
from service.job_ports import Check, JobKind, JobRun, Record
from service.jobs.tools import JobTools
from service.ports import SAMPLES_JOB, SampleFormat

#: A job is cut into about so many parts, of so many shapes at least and at most.
_PARTS, _FEWEST, _MOST = 96, 4, 64


def samples_kind(tools: JobTools) -> JobKind:
    """The kind of job: `count` shapes of `model` from `seed` on."""
    return JobKind(SAMPLES_JOB, _follow, {"draw": lambda item, check: _draw(tools, item, check)}, tools.forget)


def _follow(run: JobRun, argument: Record) -> Record:
    count = argument["count"]
    run.expect(count)
    size = min(max(math.ceil(count / _PARTS), _FEWEST), _MOST)
    items = [
        {**argument, "job": run.id, "first": first, "size": min(size, count - first)} for first in range(0, count, size)
    ]
    run.spread("draw", items, [item["size"] for item in items])
    return {"count": count}


def _draw(tools: JobTools, item: Record, check: Check) -> Record:
    files, how = tools.files(item["job"]), _how(tools, item)
    model = interruptible(tools.registry.get(item["model"]), check)
    writer = SampleWriter(tools.write_mesh, tools.write_volume)
    made = 0
    for number in range(item["first"], item["first"] + item["size"]):
        check()
        if files.has_item(number):
            continue
        tools.log.debug("item begun", job=item["job"], item=number)
        file = writer.make(model, item["seed"] + number, how)
        files.put_item(number, {file.name: file.data}, file.entry)
        made += 1
    if item["first"] == 0:
        files.put_note("manifest", json.loads(manifest_bytes(model, how, [])))
    return {"made": made}


def _how(tools: JobTools, item: Mapping[str, Any]) -> Draw:
    return Draw(
        SampleFormat(item["format"]),
        item["temperature"],
        item["spacing_mm"],
        tools.max_voxels,
        item.get("reject", True),
    )
