"""Structured logs and metrics; each application has its own, nothing is registered globally.

Neither holds a file name, a value of an image header, a query or the path of a request: only its
route as it stands in the interface.
"""

import math
import sys
import time
from collections.abc import Callable
from typing import Any, TextIO

import structlog
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest

from service.errors import Overloaded
from service.job_ports import JobEngine
from service.ports import WorkEngine

#: Upper bounds (s) of the latency histograms.
LATENCY_BUCKETS_S = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0)
#: Severity of each level as the standard library counts it.
SEVERITIES = {"debug": 10, "info": 20, "warning": 30, "error": 40}

Log = Any


def make_log(level: str, stream: TextIO | None = None) -> Log:
    """A logger that writes one JSON object a line, to standard error unless told otherwise."""
    return structlog.wrap_logger(
        structlog.WriteLogger(stream or sys.stderr),
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.dict_tracebacks,
            structlog.processors.JSONRenderer(),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(SEVERITIES[level]),
    )


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
        self.watch("morphoflow_work_waiting", "Requests that wait for a worker", engine.waiting)
        self.watch(
            "morphoflow_jobs_waiting_parts", "Parts of jobs that wait for a worker", lambda: _known(jobs.backlog)
        )
        self.watch("morphoflow_work_running", "Workers that are busy", engine.running)
        ProcessCollector(registry=self._registry)

    def exposition(self) -> bytes:
        """All of it in the text format of Prometheus."""
        return generate_latest(self._registry)

    def watch(self, name: str, text: str, value: Callable[[], float]) -> None:
        """Ask for a figure whenever metrics are read."""
        Gauge(name, text, registry=self._registry).set_function(value)


def _known(figure: Callable[[], int]) -> float:
    """The figure, or that there is none now (NaN): metrics are told even while a database is away."""
    try:
        return figure()
    except Overloaded:
        return math.nan


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


def uvicorn_logging(level: str) -> dict[str, Any]:
    """Logging of the HTTP server itself (standard library, `dictConfig`), as JSON like everything else."""
    stages = [
        structlog.stdlib.ProcessorFormatter.remove_processors_meta,
        structlog.processors.format_exc_info,
        structlog.processors.JSONRenderer(),
    ]
    before = [structlog.stdlib.add_log_level, structlog.processors.TimeStamper(fmt="iso", utc=True)]
    formatter = {"()": structlog.stdlib.ProcessorFormatter, "processors": stages, "foreign_pre_chain": before}
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"json": formatter},
        "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "json"}},
        "loggers": {"uvicorn": {"handlers": ["stderr"], "level": level.upper(), "propagate": False}},
    }
