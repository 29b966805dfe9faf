"""Domain types to wire types: what a client reads of a job."""

from datetime import UTC, datetime

from service.job_ports import JobState, JobStatus
from service.job_schemas import JobLinks, JobSummary
from service.ports import RECONSTRUCTION_JOB


def job_summary(status: JobStatus, prefix: str = "", now: datetime | None = None) -> JobSummary:
    """The wire form of a job; `prefix` is a proxy's."""
    place = f"{prefix}/v1/jobs/{status.id}"
    result = f"{prefix}/v1/reconstructions/{status.id}" if status.kind == RECONSTRUCTION_JOB else f"{place}/result"
    is_there = status.state is JobState.DONE and status.result is not None
    remaining = status.remaining_s(now or datetime.now(UTC))
    return JobSummary(
        id=status.id,
        kind=status.kind,
        state=status.state,
        created=status.created,
        started=status.started,
        finished=status.finished,
        done=status.done,
        total=status.total,
        remaining_s=None if remaining is None else round(remaining, 1),
        problem=status.problem,
        problem_type=None if status.problem_kind is None else status.problem_kind.type,
        problem_status=None if status.problem_kind is None else status.problem_kind.status,
        links=JobLinks(self=place, events=f"{place}/events", result=result if is_there else None),
    )
