"""A received drawing: its images are fetched, the shape is reconstructed, the results are given back.

Each step is idempotent and leaves files, so that a killed worker's is done again without being done twice: results
have the same identifiers, and an archive is asked what it holds before anything is sent. An archive that cannot be
reached is asked again after longer and longer waits, for ever; what cannot be used goes to quarantine.
"""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count
from threading import BoundedSemaphore

from model.errors import InputError, NotFound
from model.inference.reconstruction import Options
from service import use_cases
from service.adapters.dicom.derivation import Derivation, anatomy_of
from service.adapters.dicom.laterality import side_of
from service.adapters.dicom.masks import stacks_of_object
from service.adapters.dicom.results import result_objects
from service.adapters.dicom.series import around, series_of
from service.adapters.image_guard import ImageLimits
from service.adapters.pacs.configuration import Rule
from service.adapters.pacs.contents import content_digest
from service.adapters.pacs.delivery import Desk
from service.errors import ArchiveRefused, ArchiveUnavailable, Cancelled, GivenUp
from service.job_ports import Check, JobKind, JobRun, Record
from service.observability import Log
from service.pacs_ports import DRAWING_JOB
from service.ports import Catalogue, Outcome

#: Answers of stages.
DONE, AGAIN, MISSING, REFUSED = "done", "again", "missing", "refused"
#: Exchanges with archives that one worker has at the same time.
EXCHANGES = 4


@dataclass(frozen=True)
class DrawingTools:
    """What the job works with.

    Attributes:
        lines: bounds the exchanges with archives at the same time.
    """

    desk: Desk
    registry: Catalogue
    limits: ImageLimits
    version: str
    log: Log
    lines: AbstractContextManager[object] = field(default_factory=lambda: BoundedSemaphore(EXCHANGES))


#: Work of a stage.
Work = Callable[[DrawingTools, Record], Record]
#: A stage of a drawing; again in each turn, by its number from 0, until it is done or refused.
Stage = Callable[[int], Record]


def drawing_kind(tools: DrawingTools) -> JobKind:
    """The kind of job behind C-STORE and STOW-RS."""

    def follow(run: JobRun, drawing: Record) -> Record:
        for stage in _stages(tools, run, drawing):
            answer = _until_done(tools, run, stage)
            if answer["state"] != DONE:
                run.step("quarantine", partial(_quarantine, tools, drawing, answer["reason"]))
                return {"quarantined": answer["reason"]}
        run.step("forget", partial(_forget, tools, drawing))
        return {"stored": answer["uids"]}

    def reconstruct(item: Record, check: Check) -> Record:
        return _guarded(tools, item, partial(_reconstruct, check=check))

    return JobKind(DRAWING_JOB, follow, {"reconstruct": reconstruct})


def _stages(tools: DrawingTools, run: JobRun, drawing: Record) -> Iterator[Stage]:
    """Exchanges with archives are steps, of which many wait at the same time; the computing is a part of the queue."""
    delivered: dict[str, Record] = {}

    def exchange(name: str, work: Work) -> Record:
        return run.step(name, partial(_in_turn, tools, drawing, work))

    def reconstruct(turn: int) -> Record:
        # An item is remembered by its number, so the turns before this one are asked for again and answered at once.
        return run.spread("reconstruct", [{**drawing, "turn": number} for number in range(turn + 1)])[-1]

    def deliver(_: int) -> Record:
        # An archive that is away keeps results from no other.
        for archive in drawing["send_to"]:
            if delivered.get(archive, {"state": AGAIN})["state"] == AGAIN:
                delivered[archive] = exchange(f"deliver to {archive}", partial(_deliver, archive=archive))
        return min(delivered.values(), key=lambda answer: (AGAIN, REFUSED, DONE).index(answer["state"]))

    yield lambda _: exchange("fetch", _fetch)
    yield reconstruct
    yield deliver


def _until_done(tools: DrawingTools, run: JobRun, stage: Stage) -> Record:
    """The stage's answer, after as many turns as it takes; the time for images runs while they are missing."""
    configuration = tools.desk.configuration
    missed_s, wait_s = 0.0, configuration.retry_first_s
    for turn in count():
        try:
            answer = stage(turn)
        except GivenUp as error:
            return {"state": REFUSED, "reason": str(error)}
        if answer["state"] == MISSING and missed_s >= configuration.images_awaited_s:
            return {**answer, "state": REFUSED}
        if answer["state"] in (DONE, REFUSED):
            break
        run.wait(wait_s)
        missed_s += wait_s if answer["state"] == MISSING else 0.0
        wait_s = min(2 * wait_s, configuration.retry_longest_s)
    return answer


def _in_turn(tools: DrawingTools, drawing: Record, work: Work) -> Record:
    with tools.lines:
        return _guarded(tools, drawing, work)


def _guarded(tools: DrawingTools, item: Record, work: Work) -> Record:
    try:
        return work(tools, item)
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


def _fetch(tools: DrawingTools, item: Record) -> Record:
    gap = tools.desk.fetch(item["object"], item["rule"], _labels(item))
    return {"state": DONE} if gap is None else {"state": MISSING, "reason": gap}


def _labels(item: Record) -> frozenset[int] | None:
    return None if item["labels"] is None else frozenset(item["labels"])


def _reconstruct(tools: DrawingTools, item: Record, check: Check) -> Record:
    desk, rule = tools.desk, tools.desk.configuration.rule(item["rule"])
    drawing, series = desk.drawing(item["object"]), series_of(desk.images(item["object"]))
    labels = _labels(item)
    stacks = stacks_of_object(drawing, "object", tools.limits, labels, series.grid)
    model = tools.registry.get(rule.model)
    outcome = use_cases.reconstruct(model, stacks, _options(rule), tools.limits.max_voxels, check=check)
    series = around(series, outcome.reconstruction.mesh)
    outcome = replace(outcome, grid=series.grid)
    key = _key(str(drawing.SOPInstanceUID), content_digest(drawing, stacks, labels), outcome, labels)
    anatomy, side = anatomy_of(model.manifest), side_of(drawing, labels)
    derivation = Derivation(drawing, series, outcome, anatomy, key, tools.version, labels, side)
    volume = use_cases.probability_map(tools.registry, outcome, None, tools.limits.max_voxels, check)
    results = result_objects(derivation, volume.array, desk.moment_s(item["object"]))
    desk.put_results(item["object"], results)
    return {"state": DONE, "cut": derivation.is_cut}


def _deliver(tools: DrawingTools, item: Record, archive: str) -> Record:
    uids = tools.desk.deliver(item["object"], archive)
    tools.log.info("results stored", job=item["object"], objects=len(uids))
    return {"state": DONE, "uids": uids}


def _quarantine(tools: DrawingTools, item: Record, reason: str) -> Record:
    tools.desk.set_aside(item["object"], item["drawing"], reason)
    tools.log.warning("object quarantined", job=item["object"], reason=reason)
    return {}


def _forget(tools: DrawingTools, item: Record) -> Record:
    tools.desk.forget(item["object"])
    return {}


def _options(rule: Rule) -> Options:
    return Options("auto", rule.uncertainty, rule.mirror, None, rule.seed)


def _key(source: str, content: str, outcome: Outcome, labels: frozenset[int] | None) -> str:
    """Decides all identifiers of the results: the source and what it draws, the model and the settings."""
    key = f"{source}\n{content}\n{outcome.model_digest}\n{outcome.options}\n{sorted(labels or ())}"
    return hashlib.sha256(key.encode()).hexdigest()
