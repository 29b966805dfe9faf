"""``/v1/reconstructions/{id}``: a kept result and its parts."""

from collections.abc import Callable
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from service import use_cases
from service.ports import StoredResult
from service.presentation import result_summary
from service.request_schemas import MeshQuery, UncertaintyQuery, VolumeQuery
from service.routes.connection import run_while_connected
from service.routes.dependencies import Services, WithServices, WithTicket, address
from service.routes.meshes import mesh_bytes
from service.routes.reconstructions import PATH
from service.routes.responses import JSON, MESH_MEDIA_TYPES, NIFTI, Responses, attachment, files, problems
from service.schemas import ResultSummary, SurfaceSd
from service.use_cases import Volume

Identifier = Annotated[
    str, Path(alias="id", description="identifier of the result", json_schema_extra={"format": "uuid"})
]


def results_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=f"{PATH}/{{id}}", tags=["reconstructions"])
    router.add_api_route(
        "",
        read_summary,
        methods=["GET"],
        response_model=ResultSummary,
        summary="Summary of a result",
        responses=problems(404),
    )
    router.add_api_route(
        "",
        delete_result,
        methods=["DELETE"],
        status_code=204,
        summary="Forget a result at once",
        responses={204: {"description": "it is gone"}, **problems(404)},
    )
    router.add_api_route(
        "/mesh",
        read_mesh,
        methods=["GET"],
        response_class=Response,
        summary="Surface of a result",
        responses={200: files(MESH_MEDIA_TYPES.values(), "the surface in the input's world, mm"), **problems(404, 422)},
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


def read_summary(identifier: Identifier, request: Request, services: WithServices) -> JSONResponse:
    """Figures of a result, and where its parts are."""
    result = services.store.load(identifier)
    return JSONResponse(result_summary(result, address(request, f"{PATH}/{identifier}")).model_dump(mode="json"))


def delete_result(identifier: Identifier, services: WithServices) -> Response:
    """Its parts can no longer be read after this."""
    services.store.delete(identifier)
    return Response(status_code=204)


def read_mesh(identifier: Identifier, query: Annotated[MeshQuery, Query()], services: WithServices) -> Response:
    """The watertight surface in the input's world or in `space`, mm; the file says which where its format can."""
    data = mesh_bytes(services, services.store.load(identifier), query.format, query.max_error_mm, query.space)
    headers = attachment(f"reconstruction.{query.format.value}")
    return Response(data, media_type=MESH_MEDIA_TYPES[query.format], headers=headers)


async def read_segmentation(
    identifier: Identifier,
    query: Annotated[VolumeQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> Response:
    """A label map on the input's grid, or on a grid of its own at `spacing_mm`; 1 is the object."""
    return await run_while_connected(
        request, ticket, lambda _: _nifti(services, identifier, query, use_cases.segmentation, "segmentation")
    )


async def read_occupancy(
    identifier: Identifier,
    query: Annotated[VolumeQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> Response:
    """The probability that a voxel lies in the object, 0 to 1."""
    return await run_while_connected(
        request, ticket, lambda _: _nifti(services, identifier, query, use_cases.probability_map, "occupancy")
    )


async def read_uncertainty(
    identifier: Identifier,
    query: Annotated[UncertaintyQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> Response:
    """Voxel entropy in nats, 0 to ln 2; with `kind=surface_sd` mm at each vertex of the mesh in PLY."""
    if query.kind == "surface_sd":
        return await run_in_threadpool(_surface_sd, services, identifier)
    return await run_while_connected(
        request, ticket, lambda _: _nifti(services, identifier, query, use_cases.entropy_map, "entropy")
    )


def _surface_sd(services: Services, identifier: str) -> Response:
    outcome = services.store.load(identifier).outcome
    values = use_cases.surface_sd(outcome)
    told = SurfaceSd(space=outcome.reconstruction.space, surface_sd_mm=values.tolist())
    return JSONResponse(told.model_dump(mode="json"))


def _nifti(
    services: Services, identifier: str, query: VolumeQuery, compute: Callable[..., Volume], description: str
) -> Response:
    result: StoredResult = services.store.load(identifier)
    volume = compute(services.registry, result.outcome, query.spacing_mm, services.settings.max_voxels)
    data = services.write_volume(volume.array, volume.grid, description)
    return Response(data, media_type=NIFTI, headers=attachment(f"{description}.nii.gz"))
