"""``POST /v1/reconstructions``: masks in, a summary or a surface out."""

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Form, Request
from fastapi.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from model.errors import InvalidParameter, TooLarge, UnknownModel
from model.inference.stacks import checked_labels
from model.inference.surface import require_step
from model.interruption import Check
from service import use_cases
from service.adapters.images import image_format
from service.job_ports import JobStatus
from service.job_submission import require_stacks
from service.observability import StageTimer
from service.ports import RECONSTRUCTION_JOB, MeshFormat, StoredResult
from service.presentation import result_summary
from service.request_schemas import ReconstructionForm, parse_labels
from service.routes.connection import run_while_connected
from service.routes.dependencies import Services, WithServices, address
from service.routes.job_requests import (
    JOB_ACCEPTED,
    KeyOfJob,
    accepted_job,
    desk_of,
    own_key,
    submittable_model,
    wants_job,
)
from service.routes.masks import masks_of_form
from service.routes.meshes import mesh_bytes
from service.routes.negotiation import listed, negotiate
from service.routes.responses import DIRECT_FORMATS, JSON, MESH_MEDIA_TYPES, attachment, files, problems
from service.routes.strict import StrictRoute
from service.schemas import ResultSummary

PATH = "/v1/reconstructions"
_OFFERED = {JSON: None, **{MESH_MEDIA_TYPES[format]: format for format in DIRECT_FORMATS}}


def accepted_format(request: Request) -> MeshFormat | None:
    """Mesh format that the client wants as the answer, None for the summary; `NotAcceptable` otherwise."""
    return _OFFERED[negotiate(listed(request.headers, "accept"), tuple(_OFFERED))]


def reconstructions_router() -> APIRouter:
    """The route."""
    router = APIRouter(tags=["reconstructions"], route_class=StrictRoute)
    router.add_api_route(
        PATH,
        create_reconstruction,
        methods=["POST"],
        status_code=201,
        response_model=ResultSummary,
        summary="Reconstruct a surface from sparse masks",
        responses={
            201: {
                "description": "the summary; the header Location says where it is kept",
                "headers": {"Location": {"schema": {"type": "string"}, "description": "address of the result"}},
            },
            200: {
                **files(
                    (MESH_MEDIA_TYPES[format] for format in DIRECT_FORMATS),
                    "the mesh itself, when Accept asks for one; Content-Location says where it is kept",
                ),
                "headers": {
                    "Content-Location": {"schema": {"type": "string"}, "description": "address of the mesh"},
                    "Link": {
                        "schema": {"type": "string"},
                        "description": '`rel="describedby"`: the summary\'s address',
                    },
                },
            },
            202: JOB_ACCEPTED,
            **problems(400, 406, 413, 415, 422, 503, 507),
        },
    )
    return router


async def create_reconstruction(
    request: Request,
    form: Annotated[ReconstructionForm, Form(media_type="multipart/form-data")],
    wanted: Annotated[MeshFormat | None, Depends(accepted_format)],
    as_job: Annotated[bool, Depends(wants_job)],
    services: WithServices,
    key: KeyOfJob = None,
) -> Response:
    """Fits the model to the annotated planes of the masks.

    Answers the summary, or the mesh itself when the header Accept asks for a mesh format; with `Prefer: respond-async`
    a job at once.
    """
    if len(form.mask) > services.settings.max_masks:
        raise TooLarge(f"At most {services.settings.max_masks} parts named mask are accepted.", part="mask")
    if as_job:
        status = await services.turns.run(_enqueue, services, form, own_key(request, key), limit_s=None)
        return accepted_job(request, status)
    with services.engine.admit() as ticket:
        result = await run_while_connected(request, ticket, partial(_reconstruct, services, form))
    return await run_in_threadpool(_answer, request, services, result, wanted)


def _enqueue(services: Services, form: ReconstructionForm, key: str | None) -> JobStatus:
    desk, options = desk_of(services), form.options()
    asked = form.model_dump(exclude={"mask"}) | {"masks": len(form.mask)}
    inputs = [mask.file for mask in form.mask]
    if (earlier := desk.earlier(RECONSTRUCTION_JOB, asked, inputs, key)) is not None:
        return earlier
    model = submittable_model(services, form.model)
    checked_labels(parse_labels(form.label))
    if all(image_format(mask.file) != "dicom" for mask in form.mask):  # an object of DICOM may be several stacks
        require_stacks(options.annotated, len(form.mask))
    step, limit = options.resolution_mm, services.settings.max_voxels
    require_step(services.registry.get(model), step, limit, part="resolution_mm")
    return desk.submit(RECONSTRUCTION_JOB, asked, inputs, key, model=model)


def _reconstruct(services: Services, form: ReconstructionForm, check: Check) -> StoredResult:
    options, labels = form.options(), parse_labels(form.label)
    max_voxels = services.settings.max_voxels
    try:
        model = services.registry.get(form.model)
    except UnknownModel as error:
        raise InvalidParameter(str(error), part="model") from None
    stacks = masks_of_form(services, form.mask, labels, check)
    timer = StageTimer(services.metrics.stages)

    def observed(stage: str) -> None:
        check()
        timer(stage)

    outcome = services.compute(use_cases.reconstruct, model, stacks, options, max_voxels, watch=observed, check=check)
    timer.finish()
    return services.store.save(outcome)


def _answer(request: Request, services: Services, result: StoredResult, wanted: MeshFormat | None) -> Response:
    place = address(request, f"{PATH}/{result.id}")
    if wanted is None:
        content = result_summary(result, place).model_dump(mode="json")
        return JSONResponse(content, 201, headers={"Location": place, "Vary": "Accept"})
    headers = {
        "Content-Location": f"{place}/mesh?format={wanted.value}",
        "Link": f'<{place}>; rel="describedby"',
        "Vary": "Accept",
        **attachment(f"reconstruction.{wanted.value}"),
    }
    return Response(mesh_bytes(services, result, wanted), media_type=MESH_MEDIA_TYPES[wanted], headers=headers)
