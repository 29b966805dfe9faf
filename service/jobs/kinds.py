"""All kinds of jobs that a worker can do."""

from service.job_ports import JobKind
from service.jobs.reconstructions import reconstruction_kind, reconstructions_kind
from service.jobs.samples import samples_kind
from service.jobs.tools import JobTools


def all_kinds(tools: JobTools) -> tuple[JobKind, ...]:
    """One of each."""
    return (samples_kind(tools), reconstruction_kind(tools), reconstructions_kind(tools))
