"""``/v1/reconstructions/{id}``: a kept result and its parts."""

from collections.abc import Callable
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from model.errors import InvalidParameter
from model.interruption import Check, unchecked
from service import use_cases
from service.presentation import result_summary
from service.request_schemas import MeshQuery, UncertaintyQuery, VolumeQuery
from service.routes.connection import run_while_connected
from service.routes.dependencies import ResultId, Services, WithServices, WithTicket, address
from service.routes.meshes import mesh_bytes
from service.routes.negotiation import listed, negotiate
from service.routes.reconstructions import PATH
from service.routes.responses import JSON, MESH_MEDIA_TYPES, NIFTI, Responses, attachment, files, problems
from service.routes.strict import StrictRoute
from service.schemas import ResultSummary, SurfaceSd
from service.use_cases import Volume


def results_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=f"{PATH}/{{id}}", tags=["reconstructions"], route_class=StrictRoute)
    router.add_api_route(
        "",
        read_summary,
        methods=["GET"],
        response_model=ResultSummary,
        summary="Summary of a result",
        responses=problems(404, 422, 503),
    )
    router.add_api_route(
        "",
        delete_result,
        methods=["DELETE"],
        status_code=204,
        summary="Forget a result at once",
        responses={204: {"description": "it is gone"}, **problems(404, 422, 503)},
    )
    router.add_api_route(
        "/mesh",
        read_mesh,
        methods=["GET"],
        response_class=Response,
        summary="Surface of a result",
        responses={
            200: files(MESH_MEDIA_TYPES.values(), "the surface in the input's world, mm"),
            **problems(404, 406, 422, 503),
        },
    )
    nifti = files([NIFTI], "a gzipped NIfTI file (.nii.gz)")
    _add_volume(router, "/segmentation", read_segmentation, "Dense label map", {200: nifti})
    _add_volume(router, "/occupancy", read_occupancy, "Probability of each voxel", {200: nifti})
    uncertain = files([NIFTI], "voxel entropy (nats, .nii.gz), or the standard deviation of the surface (JSON)")
    uncertain["content"][JSON] = {"schema": {"$ref": "#/components/schemas/SurfaceSd"}}
    _add_volume(router, "/uncertainty", read_uncertainty, "Where the result is uncertain", {200: uncertain})
    return router


def _add_volume(router: APIRouter, path: str, endpoint: Callable[..., object], summary: str, answer: Responses) -> None:
    router.add_api_route(
        path,
        endpoint,
        methods=["GET"],
        response_class=Response,
        summary=summary,
        responses={**answer, **problems(404, 413, 422, 503)},
    )


def read_summary(identifier: ResultId, request: Request, services: WithServices) -> JSONResponse:
    """Figures of a result, and where its parts are."""
    result = services.store.load(identifier)
    return JSONResponse(result_summary(result, address(request, f"{PATH}/{identifier}")).model_dump(mode="json"))


def delete_result(identifier: ResultId, services: WithServices) -> Response:
    """Its parts can no longer be read after this."""
    services.store.delete(identifier)
    return Response(status_code=204)


def asked_mesh(query: Annotated[MeshQuery, Query()], request: Request) -> MeshQuery:
    """The query, with the format that the header Accept asks for where it names none; `NotAcceptable` otherwise."""
    if "format" in query.model_fields_set:
        return query
    media = negotiate(listed(request.headers, "accept"), tuple(MESH_MEDIA_TYPES.values()))
    return query.model_copy(update={"format": next(f for f, known in MESH_MEDIA_TYPES.items() if known == media)})


async def read_mesh(
    identifier: ResultId, query: Annotated[MeshQuery, Depends(asked_mesh)], request: Request, services: WithServices
) -> Response:
    """The watertight surface in the input's world or in `space`, mm; the file says which where its format can.

    As it is kept it can be had while too much work waits; fewer triangles are work like any other.
    """
    if query.max_error_mm == 0:
        return await run_in_threadpool(_mesh, services, identifier, query)
    with services.engine.admit() as ticket:
        return await run_while_connected(request, ticket, partial(_mesh, services, identifier, query))


def _mesh(services: Services, identifier: str, query: MeshQuery, check: Check = unchecked) -> Response:
    result = services.store.load(identifier)
    check()
    data = mesh_bytes(services, result, query.format, query.max_error_mm, query.space)
    headers = {**attachment(f"reconstruction.{query.format.value}"), "Vary": "Accept"}
    return Response(data, media_type=MESH_MEDIA_TYPES[query.format], headers=headers)


async def read_segmentation(
    identifier: ResultId,
    query: Annotated[VolumeQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> Response:
    """A label map on the input's grid, or on a grid of its own at `spacing_mm`; 1 is the object."""
    return await run_while_connected(
        request, ticket, partial(_nifti, services, identifier, query, use_cases.segmentation, "segmentation")
    )


async def read_occupancy(
    identifier: ResultId,
    query: Annotated[VolumeQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> Response:
    """The probability that a voxel lies in the object, 0 to 1."""
    return await run_while_connected(
        request, ticket, partial(_nifti, services, identifier, query, use_cases.probability_map, "occupancy")
    )


async def read_uncertainty(
    identifier: ResultId,
    query: Annotated[UncertaintyQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> Response:
    """Voxel entropy in nats, 0 to ln 2; with `kind=surface_sd` mm at each vertex of the mesh in PLY."""
    if query.kind == "surface_sd":
        if query.spacing_mm is not None:
            sentence = (
                "The parameter spacing_mm is of no use with kind=surface_sd, which tells of vertices, not voxels."
            )
            raise InvalidParameter(sentence, part="spacing_mm")
        return await run_in_threadpool(_surface_sd, services, identifier)
    return await run_while_connected(
        request, ticket, partial(_nifti, services, identifier, query, use_cases.entropy_map, "entropy")
    )


def _surface_sd(services: Services, identifier: str) -> Response:
    outcome = services.store.load(identifier).outcome
    values = use_cases.surface_sd(outcome)
    told = SurfaceSd(space=outcome.reconstruction.space, surface_sd_mm=values.tolist())
    return JSONResponse(told.model_dump(mode="json"))


def _nifti(
    services: Services,
    identifier: str,
    query: VolumeQuery,
    compute: Callable[..., Volume],
    description: str,
    check: Check,
) -> Response:
    outcome, limit = services.store.load(identifier).outcome, services.settings.max_voxels
    volume = compute(services.registry, outcome, query.spacing_mm, limit, check)
    check()
    data = services.write_volume(volume.array, volume.grid, description)
    return Response(data, media_type=NIFTI, headers=attachment(f"{description}.nii.gz"))
