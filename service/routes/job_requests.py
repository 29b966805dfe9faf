"""How requests become jobs: idempotency, a bound on their number, and the answer 202."""

from typing import Annotated, Any

from fastapi import Header, Request
from starlette.responses import JSONResponse, Response

from model.errors import InvalidParameter, UnknownModel
from service.job_ports import JobStatus
from service.job_presentation import job_summary
from service.job_submission import JobDesk
from service.model_registry import pinned_name
from service.routes.dependencies import Services, address, client_of
from service.routes.negotiation import listed

JOBS_PATH = "/v1/jobs"

_KEY: dict[str, Any] = {"alias": "Idempotency-Key", "min_length": 1, "max_length": 255}
_SAME = "the same key with the same request leads to the same job, however often it is sent"

IdempotencyKey = Annotated[str | None, Header(**_KEY, description=_SAME)]
#: Of a request that is a job only when it asks for one.
KeyOfJob = Annotated[
    str | None,
    Header(**_KEY, description=f"with `Prefer: respond-async` {_SAME}; without it every request is computed anew"),
]
Prefer = Annotated[str | None, Header(alias="Prefer", description="`respond-async` answers a job at once (RFC 7240)")]

#: Description of the answer to a request that became a job.
JOB_ACCEPTED: dict[str, Any] = {
    "description": "the request has become a job",
    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/JobSummary"}}},
    "headers": {
        "Location": {"schema": {"type": "string"}, "description": "address of the job"},
        "Preference-Applied": {"schema": {"type": "string"}, "description": "`respond-async` when Prefer asked for it"},
    },
}


def prefers_async(request: Request) -> bool:
    """Whether the header Prefer, on any of its lines, asks for an answer at once."""
    wishes = (listed(request.headers, "prefer") or "").split(",")
    return any(wish.split(";")[0].strip().lower() == "respond-async" for wish in wishes)


def wants_job(request: Request, _: Prefer = None) -> bool:
    """`prefers_async` as what a route depends on, which puts the header into the interface's description."""
    return prefers_async(request)


def submittable_model(services: Services, name: str | None) -> str:
    """The model of a form as ``name@version``, so that a job keeps it; `InvalidParameter` for an unknown one."""
    try:
        return pinned_name(services.registry.get(name))
    except UnknownModel as error:
        raise InvalidParameter(str(error), part="model") from None


def desk_of(services: Services) -> JobDesk:
    """Where jobs are taken in."""
    return JobDesk(services.jobs, services.blobs, services.settings.max_jobs)


def own_key(request: Request, key: str | None) -> str | None:
    """An idempotency key among those of the same client: what others call theirs is another one."""
    client = client_of(request)
    return key if key is None or client is None else f"{client}\n{key}"


def accepted_job(request: Request, status: JobStatus) -> Response:
    """The answer 202 with the job's address; says that a preference was met when there was one (RFC 7240, 3)."""
    place = address(request, f"{JOBS_PATH}/{status.id}")
    applied = {"Preference-Applied": "respond-async"} if prefers_async(request) else {}
    headers = {"Location": place, **applied}
    return JSONResponse(job_summary(status, address(request, "")).model_dump(mode="json"), 202, headers=headers)
