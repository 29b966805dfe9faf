"""A received drawing: its images are fetched, the shape is reconstructed, the results are given back.

Each step is idempotent and leaves files, so that a killed worker's is done again without being done twice: results
have the same identifiers, and an archive is asked what it holds before anything is sent. An archive that cannot be
reached is asked again after longer and longer waits, for ever; what cannot be used goes to quarantine.
"""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from model.errors import InputError, NotFound
from model.inference.reconstruction import Options
from service import use_cases
from service.adapters.dicom.derivation import Derivation, anatomy_of
from service.adapters.dicom.masks import stacks_of_object
from service.adapters.dicom.results import result_objects
from service.adapters.dicom.series import series_of
from service.adapters.image_guard import ImageLimits
from service.adapters.pacs.configuration import Rule
from service.adapters.pacs.delivery import Desk
from service.errors import ArchiveRefused, ArchiveUnavailable, Cancelled
from service.job_ports import Check, JobKind, JobRun, Record
from service.observability import Log
from service.pacs_ports import DRAWING_JOB
from service.ports import Catalogue, Outcome

#: Answers of parts.
DONE, AGAIN, MISSING, REFUSED = "done", "again", "missing", "refused"


@dataclass(frozen=True)
class DrawingTools:
    """What the job works with."""

    desk: Desk
    registry: Catalogue
    limits: ImageLimits
    version: str
    log: Log


Work = Callable[[DrawingTools, Record, Check], Record]
Part = Callable[[Record, Check], Record]


def drawing_kind(tools: DrawingTools) -> JobKind:
    """The kind of job behind C-STORE and STOW-RS."""

    def follow(run: JobRun, argument: Record) -> Record:
        for part in ("fetch", "reconstruct", *map(_delivery, argument["send_to"])):
            answer = _until_done(tools, run, part, argument)
            if answer["state"] != DONE:
                run.spread("quarantine", [{**argument, "reason": answer["reason"]}])
                return {"quarantined": answer["reason"]}
        run.spread("forget", [argument])
        return {"stored": answer["uids"]}

    parts: dict[str, Part] = {
        "fetch": partial(_guarded, tools, work=_fetch),
        "reconstruct": partial(_guarded, tools, work=_reconstruct),
        **{
            _delivery(archive.name): partial(_guarded, tools, work=partial(_deliver, archive.name))
            for archive in tools.desk.configuration.archives
        },
        "quarantine": lambda item, _: _quarantine(tools, item),
        "forget": lambda item, _: _forget(tools, item),
    }
    return JobKind(DRAWING_JOB, follow, parts)


def _until_done(tools: DrawingTools, run: JobRun, part: str, item: Record) -> Record:
    """The part's answer, after as many turns as it takes; a turn is remembered, and so is the wait before it."""
    configuration = tools.desk.configuration
    turn, waited, wait_s = 0, 0.0, configuration.retry_first_s
    while True:
        # An item is remembered by its number, so the turns before this one are asked for again and answered at once.
        answer = run.spread(part, [{**item, "turn": number} for number in range(turn + 1)])[-1]
        lasts = waited < configuration.images_awaited_s
        if answer["state"] == MISSING and not lasts:
            return {**answer, "state": REFUSED}
        if answer["state"] in (DONE, REFUSED):
            return answer
        run.step("wait", partial(_sleep, wait_s))
        turn, waited, wait_s = turn + 1, waited + wait_s, min(2 * wait_s, configuration.retry_longest_s)


def _sleep(seconds: float) -> Record:
    time.sleep(seconds)
    return {}


def _guarded(tools: DrawingTools, item: Record, check: Check, work: Work) -> Record:
    try:
        return work(tools, item, check)
    except FileNotFoundError:
        return {"state": REFUSED, "reason": "The files of the drawing are gone."}
    except (ArchiveUnavailable, OSError) as error:
        reason = str(error) if isinstance(error, ArchiveUnavailable) else "A file or a connection failed."
        tools.log.warning("archive awaited", job=item["object"], reason=reason)
        return {"state": AGAIN, "reason": reason}
    except (InputError, NotFound, ArchiveRefused) as error:
        return {"state": REFUSED, "reason": str(error)}
    except Cancelled:
        raise
    except Exception as fault:  # noqa: BLE001 - an object that the program stumbles over must not be lost among faults
        tools.log.error("drawing met a fault", job=item["object"], fault=type(fault).__name__)
        return {"state": REFUSED, "reason": "The drawing met a fault of the program."}


def _fetch(tools: DrawingTools, item: Record, check: Check) -> Record:
    check()
    if tools.desk.fetch(item["object"], item["rule"]):
        return {"state": DONE}
    return {"state": MISSING, "reason": "The images that the drawing refers to are not in the archive."}


def _reconstruct(tools: DrawingTools, item: Record, check: Check) -> Record:
    desk, rule = tools.desk, tools.desk.configuration.rule(item["rule"])
    drawing, series = desk.drawing(item["object"]), series_of(desk.images(item["object"]))
    labels = None if item["labels"] is None else frozenset(item["labels"])
    stacks = stacks_of_object(drawing, "object", tools.limits, labels, series.grid)
    model = tools.registry.get(rule.model)
    outcome = use_cases.reconstruct(model, stacks, _options(rule), check=check)
    outcome = replace(outcome, grid=series.grid)
    key = _key(str(drawing.SOPInstanceUID), outcome, labels)
    derivation = Derivation(drawing, series, outcome, anatomy_of(model.manifest), key, tools.version)
    volume = use_cases.probability_map(tools.registry, outcome, None, tools.limits.max_voxels)
    desk.put_results(item["object"], result_objects(derivation, volume.array))
    return {"state": DONE, "cut": derivation.is_cut}


def _delivery(archive: str) -> str:
    """Name of the part that gives results to an archive."""
    return f"deliver to {archive}"


def _deliver(archive: str, tools: DrawingTools, item: Record, check: Check) -> Record:
    check()
    uids = tools.desk.deliver(item["object"], archive)
    tools.log.info("results stored", job=item["object"], objects=len(uids))
    return {"state": DONE, "uids": uids}


def _quarantine(tools: DrawingTools, item: Record) -> Record:
    tools.desk.set_aside(item["object"], item["reason"])
    tools.log.warning("object quarantined", job=item["object"], reason=item["reason"])
    return {}


def _forget(tools: DrawingTools, item: Record) -> Record:
    tools.desk.forget(item["object"])
    return {}


def _options(rule: Rule) -> Options:
    return Options("auto", rule.uncertainty, rule.mirror, None, rule.seed)


def _key(source: str, outcome: Outcome, labels: frozenset[int] | None) -> str:
    """Decides all identifiers of the results: the source, the model and the settings."""
    content = f"{source}\n{outcome.model_digest}\n{outcome.options}\n{sorted(labels or ())}"
    return hashlib.sha256(content.encode()).hexdigest()
