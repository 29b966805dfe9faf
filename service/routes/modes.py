"""``/v1/models/{model}/modes`` and ``/shape``: what the dimensions of a model move."""

from collections.abc import Mapping
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request
from starlette.responses import JSONResponse, Response

from model.bundle import ShapeModel
from model.interruption import Check
from service import use_cases
from service.mode_presentation import mode_list
from service.mode_schemas import ModeList, ModeMeshQuery, ModeQuery, ShapeQuery, parse_coordinates
from service.provenance import metadata_of
from service.routes.caching import (
    CONDITIONAL,
    cached,
    caching_headers,
    confirmed,
    is_held,
    names_version,
    not_modified,
)
from service.routes.connection import run_while_connected
from service.routes.dependencies import Services, WithModel, WithServices, address
from service.routes.models import PATH
from service.routes.responses import MESH_MEDIA_TYPES, Responses, attachment, files, problems
from service.routes.strict import StrictRoute

Rank = Annotated[int, Path(ge=1, description="of the mode, from 1")]


def modes_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=f"{PATH}/{{model}}", tags=["modes"], route_class=StrictRoute)
    router.add_api_route(
        "/modes",
        list_modes,
        methods=["GET"],
        response_model=ModeList,
        summary="Modes of shape, by what they move",
        responses={**cached({"description": "the modes by rank"}, lasting=False), **problems(404, 422, 503)},
        openapi_extra=CONDITIONAL,
    )
    for path, endpoint, summary in (
        ("/modes/{rank}", read_mode, "The surface along one mode"),
        ("/shape", read_shape, "The surface at coordinates along several modes"),
    ):
        router.add_api_route(
            path,
            endpoint,
            methods=["GET"],
            response_class=Response,
            summary=summary,
            responses={**_cached_mesh(), **problems(404, 413, 422, 503)},
            openapi_extra=CONDITIONAL,
        )
    return router


async def list_modes(request: Request, model: WithModel, services: WithServices) -> Response:
    """Dimensions of the flow's base, ranked by how far one standard deviation moves the mean surface."""
    headers = caching_headers(services, model, "modes", address(request, ""), lasting=names_version(request))
    if is_held(request, headers):
        return not_modified(headers)
    with services.engine.admit() as ticket:
        modes = await run_while_connected(request, ticket, partial(use_cases.modes_of, model, services.modes))
    place = address(request, f"{PATH}/{model.manifest.name}/modes")
    return confirmed(request, JSONResponse(mode_list(model, modes, place).model_dump(mode="json"), headers=headers))


async def read_mode(
    rank: Rank,
    query: Annotated[ModeQuery, Query()],
    request: Request,
    model: WithModel,
    services: WithServices,
) -> Response:
    """The mean shape moved `sd` standard deviations along the mode; vertices carry the displacement by one more."""
    return await _mesh(request, services, model, {rank: query.sd}, query)


async def read_shape(
    query: Annotated[ShapeQuery, Query()],
    request: Request,
    model: WithModel,
    services: WithServices,
) -> Response:
    """The mean shape moved along several modes at once; vertices carry the distance to the mean."""
    return await _mesh(request, services, model, parse_coordinates(query.mode), query)


async def _mesh(
    request: Request,
    services: Services,
    model: ShapeModel,
    coordinates: Mapping[int, float],
    query: ModeMeshQuery,
) -> Response:
    where = sorted(coordinates.items())
    asked = where, query.format.value, query.spacing_mm
    headers = caching_headers(services, model, "shape", *asked, lasting=names_version(request))
    if is_held(request, headers):
        return not_modified(headers)
    with services.engine.admit() as ticket:
        data = await run_while_connected(request, ticket, partial(_bytes, services, model, coordinates, query))
    headers |= attachment(f"{model.manifest.name}-shape.{query.format.value}")
    return confirmed(request, Response(data, media_type=MESH_MEDIA_TYPES[query.format], headers=headers))


def _bytes(
    services: Services, model: ShapeModel, coordinates: Mapping[int, float], query: ModeMeshQuery, check: Check
) -> bytes:
    limit = services.settings.max_voxels
    modes = use_cases.modes_of(model, services.modes, check)
    mesh = use_cases.shape_along_modes(model, modes, coordinates, query.spacing_mm, limit, check)
    where = " ".join(f"{rank}:{sd:g}" for rank, sd in sorted(coordinates.items()))
    metadata = {**metadata_of(model), "modes": where}
    return services.write_mesh(mesh, query.format.value, space=model.manifest.frame, metadata=metadata)


def _cached_mesh() -> Responses:
    return cached(files(MESH_MEDIA_TYPES.values(), "the surface in the model's canonical frame, mm"), lasting=False)
