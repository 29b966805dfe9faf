"""How requests become jobs: idempotency, a bound on their number, and the answer 202."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from fastapi import Header, Request
from starlette.responses import JSONResponse, Response

from model.errors import InvalidParameter, UnknownModel
from service.job_ports import JobStatus
from service.job_presentation import job_summary
from service.job_submission import JobDesk
from service.model_registry import pinned_name
from service.routes.dependencies import Services, address

JOBS_PATH = "/v1/jobs"

IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=255,
        description="the same key with the same request leads to the same job, however often it is sent",
    ),
]
Prefer = Annotated[str | None, Header(alias="Prefer", description="`respond-async` answers a job at once (RFC 7240)")]

#: Description of the answer to a request that became a job.
JOB_ACCEPTED: dict[str, Any] = {
    "description": "the request has become a job",
    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/JobSummary"}}},
    "headers": {"Location": {"schema": {"type": "string"}, "description": "address of the job"}},
}


def prefers_async(prefer: str | None) -> bool:
    """Whether the header Prefer asks for an answer at once."""
    return any(item.strip().split(";")[0].lower() == "respond-async" for item in (prefer or "").split(","))


def submittable_model(services: Services, name: str | None) -> str:
    """The model of a form as ``name@version``, so that a job keeps it; `InvalidParameter` for an unknown one."""
    try:
        return pinned_name(services.registry.get(name))
    except UnknownModel as error:
        raise InvalidParameter(str(error), part="model") from None


def submit(
    services: Services, kind: str, argument: Mapping[str, Any], inputs: Sequence[bytes], key: str | None
) -> JobStatus:
    """Make a job; errors as of `JobDesk.submit`."""
    desk = JobDesk(services.jobs, services.blobs, services.settings.max_jobs)
    return desk.submit(kind, argument, inputs, key)


def accepted_job(request: Request, status: JobStatus) -> Response:
    """The answer 202 with the job's address."""
    place = address(request, f"{JOBS_PATH}/{status.id}")
    headers = {"Location": place, "Preference-Applied": "respond-async"}
    return JSONResponse(job_summary(status, address(request, "")).model_dump(mode="json"), 202, headers=headers)
