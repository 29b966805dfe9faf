"""Structured logs and metrics; each application has its own, nothing is registered globally.

Neither holds a file name, a value of an image header, a query or the path of a request: only its
route as it stands in the interface, and of a fault where in the program it arose.
"""

import logging
import logging.config
import re
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import structlog
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest

from model.errors import MorphoFlowError
from service.job_figures import Recent
from service.job_ports import JobEngine
from service.ports import WorkEngine

#: Upper bounds (s) of the latency histograms.
LATENCY_BUCKETS_S = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0)
#: Severity of each level as the standard library counts it.
SEVERITIES = {"debug": 10, "info": 20, "warning": 30, "error": 40}
#: Exceptions of one chain, and frames of each, that are logged; of more frames the innermost.
MOST_EXCEPTIONS, MOST_FRAMES = 16, 40
#: How a trace that is text begins, a frame of it, and the kind of what was raised: a helper's fault comes through a
#: pipe as one.
_TRACE = "Traceback (most recent call last):\n"
_FRAME = re.compile(r'^  File "(.+)", line (\d+), in (\S+)$', re.MULTILINE)
_RAISED = re.compile(r"^[A-Za-z][\w.]*(?:Error|Exception)(?=:|$)", re.MULTILINE)
#: Libraries whose messages hold nothing of requests in their first line.
_SPEAKS = ("asyncio", "uvicorn")
#: The same message of one place is written once in so long (s): a server without descriptors has one a connection.
REPEATED_AFTER_S = 10.0
#: The folder that holds this program's packages.
_HOME = Path(__file__).parents[1]

Log = Any
ExceptionInfo = tuple[type[BaseException], BaseException, TracebackType | None]


def make_log(level: str, stream: TextIO | None = None) -> Log:
    """A logger that writes one JSON object a line, to standard error unless told otherwise."""
    return structlog.wrap_logger(
        structlog.WriteLogger(stream or sys.stderr),
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.ExceptionRenderer(exception_told),
            structlog.processors.JSONRenderer(),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(SEVERITIES[level]),
    )


@contextmanager
def going_on(log: Log, event: str) -> Iterator[None]:
    """Log what fails in a turn of what is done again and again, and let the next turn come."""
    try:
        yield
    except Exception as fault:
        log.warning(event, exc_info=fault)


def exception_told(exc_info: ExceptionInfo) -> list[dict[str, Any]]:
    """An exception and what led to it, the last one first: kind, and where in the program it arose.

    No values of variables. What an exception says is told of this program's own alone, whose sentences hold nothing of
    anybody; a foreign one's may hold paths and contents of files.
    """
    return [_told(error) for error, _ in zip(_chain(exc_info[1]), range(MOST_EXCEPTIONS), strict=False)]


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    seen: set[int] = set()
    waiting = [error]
    while waiting:
        found = waiting.pop(0)
        if found is None or id(found) in seen:
            continue
        seen.add(id(found))
        yield found
        within = found.exceptions if isinstance(found, BaseExceptionGroup) else ()
        before = found.__cause__ or (None if found.__suppress_context__ else found.__context__)
        waiting = [*within, before, *waiting]


def _told(error: BaseException) -> dict[str, Any]:
    frames = [(code.filename, code.lineno, code.name) for code in traceback.extract_tb(error.__traceback__)]
    told: dict[str, Any] = {"exc_type": type(error).__name__}
    if str(error).startswith(_TRACE):
        frames += _FRAME.findall(str(error))
        told["raised"] = _RAISED.findall(str(error))
    places = [{"filename": _place(file), "lineno": int(line or 0), "name": name} for file, line, name in frames]
    told["frames"] = places[-MOST_FRAMES:]
    return {**told, "exc_value": str(error)} if isinstance(error, MorphoFlowError) else told


def _place(file: str) -> str:
    """A file of code as seen from the folder that its package lies in."""
    roots = [_HOME, *(Path(entry) for entry in sys.path if entry)]
    within = [Path(file).relative_to(root) for root in roots if Path(file).is_relative_to(root)]
    known = [found for found in within if found.suffix == ".py"]
    return min(known, key=lambda found: len(found.parts)).as_posix() if known else "elsewhere"


class Metrics:
    """Counters of one application."""

    def __init__(self, engine: WorkEngine, jobs: JobEngine) -> None:
        self._registry = CollectorRegistry()
        self.requests = Counter(
            "morphoflow_requests", "Requests answered", ["method", "route", "status"], registry=self._registry
        )
        self.latency = Histogram(
            "morphoflow_request_seconds",
            "Time to answer",
            ["route"],
            buckets=LATENCY_BUCKETS_S,
            registry=self._registry,
        )
        self.stages = Histogram(
            "morphoflow_stage_seconds",
            "Time of each stage of a reconstruction",
            ["stage"],
            buckets=LATENCY_BUCKETS_S,
            registry=self._registry,
        )
        self._gauge("morphoflow_work_waiting", "Requests that wait for a worker", engine.waiting)
        self.watch("morphoflow_jobs_waiting_parts", "Parts of jobs that wait for a worker", jobs.backlog)
        self.watch("morphoflow_jobs_unfinished", "Jobs that wait or run, but for archives", jobs.unfinished)
        self._gauge("morphoflow_work_running", "Workers that are busy", engine.running)
        ProcessCollector(registry=self._registry)

    def exposition(self) -> bytes:
        """All of it in the text format of Prometheus."""
        return generate_latest(self._registry)

    def watch(self, name: str, text: str, value: Callable[[], float]) -> None:
        """Ask a database or a storage for a figure when metrics are read; NaN while it does not answer."""
        self._gauge(name, text, Recent(value))

    def _gauge(self, name: str, text: str, value: Callable[[], float]) -> None:
        Gauge(name, text, registry=self._registry).set_function(value)


class StageTimer:
    """Measures the stages of one reconstruction; call it as `watch`, then `finish`."""

    def __init__(self, stages: Histogram, clock: Callable[[], float] = time.perf_counter) -> None:
        self._stages = stages
        self._clock = clock
        self._stage: str | None = None
        self._began = 0.0

    def __call__(self, stage: str) -> None:
        """A stage begins, so the one before it has ended."""
        self.finish()
        self._stage, self._began = stage, self._clock()

    def finish(self) -> None:
        """The last stage has ended."""
        if self._stage is not None:
            self._stages.labels(self._stage).observe(self._clock() - self._began)
        self._stage = None


def log_everything(level: str) -> Log:
    """Write what this process says from here on to standard error as entries of a log, and give that log."""
    log = make_log(level)
    logging.config.dictConfig(library_logging(level))
    warnings.showwarning = _warned(log)
    sys.excepthook = lambda kind, error, trace: _ended(log, kind, error, trace)
    threading.excepthook = lambda ended: _ended(log, ended.exc_type, ended.exc_value, ended.exc_traceback)
    return log


def library_logging(level: str) -> dict[str, Any]:
    """Logging of the standard library (`dictConfig`): all of the HTTP server, and warnings of everything else."""
    stages = [
        structlog.stdlib.ProcessorFormatter.remove_processors_meta,
        structlog.processors.ExceptionRenderer(exception_told),
        structlog.processors.JSONRenderer(),
    ]
    before = [structlog.stdlib.add_log_level, _without_contents, structlog.processors.TimeStamper(fmt="iso", utc=True)]
    formatter = {"()": structlog.stdlib.ProcessorFormatter, "processors": stages, "foreign_pre_chain": before}
    handler = {"class": "logging.StreamHandler", "formatter": "json"}
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"json": formatter},
        "filters": {"seldom": {"()": Seldom}},
        "handlers": {"server": handler, "libraries": {**handler, "filters": ["seldom"]}},
        "root": {"handlers": ["libraries"], "level": "WARNING"},
        "loggers": {"uvicorn": {"handlers": ["server"], "level": level.upper(), "propagate": False}},
    }


class Seldom(logging.Filter):
    """Lets what one place says again and again pass once in `REPEATED_AFTER_S`."""

    def __init__(self) -> None:
        super().__init__()
        self._passed: dict[tuple[str, int, str], float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is written."""
        origin = record.name, record.lineno, _first_line(record.getMessage())
        if record.created < self._passed.get(origin, float("-inf")) + REPEATED_AFTER_S:
            return False
        self._passed = {one: at for one, at in self._passed.items() if at + REPEATED_AFTER_S > record.created}
        self._passed[origin] = record.created
        return True


def _without_contents(_logger: object, _method: str, entry: dict[str, Any]) -> dict[str, Any]:
    record: logging.LogRecord = entry["_record"]
    said, library = str(entry["event"]), record.name.split(".")[0]
    entry["event"], entry["logger"] = _first_line(said), record.name
    if said.startswith(_TRACE):  # the server tells a fault at its start or end as text
        entry["event"], entry["exc_info"] = "fault", RuntimeError(said)
    elif library not in _SPEAKS:
        entry.update(event="a library has a message", filename=_place(record.pathname), lineno=record.lineno)
    return entry


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0]


def _warned(log: Log) -> Any:
    def show(_: object, category: type[Warning], filename: str, lineno: int, *_more: object) -> None:
        log.warning("a library warns", category=category.__name__, filename=_place(filename), lineno=lineno)

    return show


def _ended(log: Log, kind: type[BaseException], error: BaseException | None, trace: TracebackType | None) -> None:
    if error is not None and not issubclass(kind, KeyboardInterrupt | SystemExit):
        log.error("fault", exc_info=(kind, error, trace))
