"""``/v1/jobs``: long work that survives a restart, its progress, and what it made."""

import asyncio
from collections.abc import AsyncIterator, Iterable, Iterator
from dataclasses import replace
from itertools import chain
from typing import Annotated, Any

from fastapi import APIRouter, Form, Path, Request
from starlette.responses import JSONResponse, RedirectResponse, Response, StreamingResponse
from zipstream import ZipStream  # type: ignore[import-untyped]

from model.inference.surface import require_step
from service import use_cases
from service.errors import KINDS, Cancelled, NotReady, Overloaded, UnknownJob, UnknownResult
from service.job_files import JobFiles, remove_job
from service.job_ports import JobState, JobStatus
from service.job_presentation import job_summary
from service.job_results import GIVEN_BACK, MANIFEST, RESULT_GONE, result_members
from service.job_schemas import JobForm, JobSummary
from service.job_submission import require_archive
from service.ports import RECONSTRUCTION_JOB, RECONSTRUCTIONS_JOB, SAMPLES_JOB
from service.request_schemas import parse_annotated
from service.routes.dependencies import Services, WithServices, address
from service.routes.job_requests import (
    JOB_ACCEPTED,
    JOBS_PATH,
    IdempotencyKey,
    accepted_job,
    desk_of,
    own_key,
    submittable_model,
)
from service.routes.responses import ZIP, attachment, files, problems
from service.routes.strict import StrictRoute

#: How often (s) a job is looked at for its events, and how often a silent line is sent so that proxies stay.
_EVENT_POLL_S, _EVENT_SILENCE_S = 0.5, 15.0
_EVENTS = {"description": "server-sent events", "content": {"text/event-stream": {"schema": {"type": "string"}}}}

Identifier = Annotated[str, Path(alias="id", description="identifier of the job", json_schema_extra={"format": "uuid"})]


def jobs_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=JOBS_PATH, tags=["jobs"], route_class=StrictRoute)
    router.add_api_route(
        "",
        create_job,
        methods=["POST"],
        status_code=202,
        response_model=JobSummary,
        summary="Bulk sampling, or a reconstruction for each mask of a ZIP",
        responses={202: JOB_ACCEPTED, **problems(400, 413, 415, 422, 503, 507)},
    )
    one = "/{id}"
    router.add_api_route(
        one,
        read_job,
        methods=["GET"],
        response_model=JobSummary,
        summary="State and progress",
        responses=problems(404, 422, 503),
    )
    router.add_api_route(
        one,
        end_job,
        methods=["DELETE"],
        response_model=JobSummary,
        summary="Cancel a job, or forget one that has ended",
        responses={204: {"description": "it had ended, and is gone with its files"}, **problems(404, 422, 503)},
    )
    router.add_api_route(
        f"{one}/events",
        read_events,
        methods=["GET"],
        response_class=StreamingResponse,
        summary="Progress as it happens",
        responses={200: _EVENTS, **problems(404, 422, 503)},
    )
    router.add_api_route(
        f"{one}/result",
        read_result,
        methods=["GET"],
        response_class=Response,
        summary="What a job has made",
        responses={
            200: files([ZIP], f"one file an item; {MANIFEST} comes last"),
            303: {"description": "a single reconstruction stands at the address in Location"},
            **problems(404, 409, 422, 503),
        },
    )
    return router


async def create_job(
    request: Request,
    form: Annotated[JobForm, Form(media_type="multipart/form-data")],
    services: WithServices,
    key: IdempotencyKey = None,
) -> Response:
    """Answers at once; the work is done by other processes and goes on after a restart."""
    key = own_key(request, key)
    return accepted_job(request, await services.turns.run(_submitted, services, form, key, limit_s=None))


def _submitted(services: Services, form: JobForm, key: str | None) -> JobStatus:
    desk, asked = desk_of(services), form.argument()
    inputs = [] if form.archive is None else [form.archive.file]
    if (earlier := desk.earlier(form.kind, asked, inputs, key)) is not None:
        return earlier
    model = submittable_model(services, form.model)
    _require_feasible(services, form.kind, asked, model)
    for archive in inputs:
        require_archive(archive, parse_annotated(form.annotated), services.settings.archive_limits)
    return desk.submit(form.kind, asked, inputs, key, model=model)


async def read_job(identifier: Identifier, request: Request, services: WithServices) -> JobSummary:
    """Items that are made, and the estimated time to the end."""
    status = await services.turns.run(_status, services, identifier)
    return job_summary(status, address(request, ""))


def _status(services: Services, identifier: str) -> JobStatus:
    """What is known of a job; one whose result is kept by itself, and is gone, says so."""
    status = services.jobs.status(identifier)
    is_kept = status.kind != RECONSTRUCTION_JOB or status.state is not JobState.DONE or services.store.has(identifier)
    return status if is_kept else replace(status, result=None, problem=RESULT_GONE, problem_kind=KINDS[UnknownResult])


async def end_job(identifier: Identifier, request: Request, services: WithServices) -> Response:
    """What runs stops within a second; a job that had ended is forgotten."""
    cancelled = await services.turns.run(_ended, services, identifier)
    if cancelled is None:
        return Response(status_code=204)
    return JSONResponse(job_summary(cancelled, address(request, "")).model_dump(mode="json"))


def _ended(services: Services, identifier: str) -> JobStatus | None:
    """A job that is cancelled now; None for one that had ended, and is forgotten."""
    if not services.jobs.status(identifier).state.is_final:
        return services.jobs.cancel(identifier)
    try:
        remove_job(services.blobs, services.store, identifier)
        services.jobs.forget(identifier)
        remove_job(services.blobs, services.store, identifier)  # a part that ran until now; one that still runs does it
    except OSError as fault:
        raise Overloaded("The job's files cannot be removed now; send the request again later.") from fault
    return None


async def read_events(identifier: Identifier, request: Request, services: WithServices) -> Response:
    """An event `progress` with the job's summary at each change, then one called `end`.

    A stream without an `end` was ended by the service, which shuts down; ask again.
    """
    first = await services.turns.run(_status, services, identifier)
    stream = _events(services, first, address(request, ""))
    return StreamingResponse(stream, media_type="text/event-stream", headers={"X-Accel-Buffering": "no"})


async def read_result(identifier: Identifier, request: Request, services: WithServices) -> Response:
    """A ZIP that streams while it is read; the same items as of single requests."""
    status = await services.turns.run(_status, services, identifier)
    if status.state is JobState.CANCELLED:
        raise Cancelled("The job was cancelled, so it has no result.")
    if status.state is JobState.DONE and status.problem == RESULT_GONE:
        raise UnknownResult(RESULT_GONE)
    if status.state is not JobState.DONE or status.result is None:
        why = f" {status.problem}" if status.problem else ""
        raise NotReady(f"The job has no result: its state is {status.state.value}.{why}", status.problem_kind)
    if status.kind == RECONSTRUCTION_JOB:
        return RedirectResponse(address(request, f"/v1/reconstructions/{identifier}"), 303)
    if status.kind not in (SAMPLES_JOB, RECONSTRUCTIONS_JOB):
        raise UnknownResult(GIVEN_BACK)
    members = result_members(JobFiles(services.blobs, identifier), status.kind, status.result["count"])
    first = await services.turns.run(next, members)  # what is gone, or cannot be read, is told before anything is sent
    return StreamingResponse(_zip(chain([first], members)), media_type=ZIP, headers=attachment(f"{status.kind}.zip"))


async def _events(services: Services, status: JobStatus, prefix: str) -> AsyncIterator[str]:
    told, silent_s = None, 0.0
    while not services.closing.is_set():
        now = (status.state, status.done, status.total)
        if now != told:
            told, silent_s = now, 0.0
            name = "end" if status.state.is_final else "progress"
            yield f"event: {name}\ndata: {job_summary(status, prefix).model_dump_json()}\n\n"
        if status.state.is_final:
            return
        if silent_s >= _EVENT_SILENCE_S:
            silent_s = 0.0
            yield ":\n\n"
        await asyncio.sleep(_EVENT_POLL_S)
        silent_s += _EVENT_POLL_S
        if not services.closing.is_set():
            status = await _looked_at(services, status)


async def _looked_at(services: Services, status: JobStatus) -> JobStatus:
    """A job as it is now; one that was deleted has been cancelled for good."""
    try:
        return await services.turns.run(services.jobs.status, status.id)
    except Overloaded:  # the database is away; the next look may find it
        return status
    except UnknownJob:
        return replace(status, state=JobState.CANCELLED, problem="The job was deleted.", problem_kind=KINDS[UnknownJob])


def _zip(members: Iterable[tuple[str, bytes]]) -> Iterator[bytes]:
    archive = ZipStream(sized=False)
    for name, data in members:
        archive.add(data, name)
        yield from archive.all_files()
    yield from archive.finalize()


def _require_feasible(services: Services, kind: str, asked: dict[str, Any], model: str) -> None:
    limits = services.settings
    if kind == SAMPLES_JOB:
        use_cases.batch_seeds(asked["seed"], asked["count"], limits.max_job_samples)
    step = "spacing_mm" if kind == SAMPLES_JOB else "resolution_mm"
    require_step(services.registry.get(model), asked[step], limits.max_voxels, part=step)
