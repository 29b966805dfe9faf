"""``/v1/reconstructions/{id}/comparison``: where two results differ, as a signed distance on the surface of one."""

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.responses import Response

from model.interruption import Check
from service import use_cases
from service.ports import MeshFormat
from service.provenance import metadata_of
from service.request_schemas import ComparisonQuery
from service.routes.connection import run_while_connected
from service.routes.dependencies import ResultId, Services, WithServices, WithTicket, result_of_parameter
from service.routes.reconstructions import PATH
from service.routes.responses import MESH_MEDIA_TYPES, attachment, files, problems
from service.routes.strict import StrictRoute

#: Formats that have room for scalars.
SCALAR_FORMATS = (MeshFormat.PLY, MeshFormat.GLB, MeshFormat.VTP, MeshFormat.MZ3)


def comparisons_router() -> APIRouter:
    """The route."""
    router = APIRouter(tags=["reconstructions"], route_class=StrictRoute)
    media_types = [MESH_MEDIA_TYPES[format] for format in SCALAR_FORMATS]
    router.add_api_route(
        f"{PATH}/{{id}}/comparison",
        read_comparison,
        methods=["GET"],
        response_class=Response,
        summary="Where two results differ",
        responses={200: files(media_types, "the surface with its signed distance"), **problems(404, 422, 503)},
    )
    return router


async def read_comparison(
    identifier: ResultId,
    query: Annotated[ComparisonQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> Response:
    """The surface of this result in its input's world, or in `space`.

    The scalar `signed_distance_mm` is positive where it lies outside the other one.
    """
    return await run_while_connected(request, ticket, partial(_comparison, services, identifier, query))


def _comparison(services: Services, identifier: str, query: ComparisonQuery, check: Check) -> Response:
    outcome = services.store.load(identifier).outcome
    other = result_of_parameter(services, query.other, "other").outcome
    check()
    mesh = use_cases.compare(outcome, other)
    check()
    format, space = MeshFormat(query.format), query.space or outcome.reconstruction.space
    data = services.write_mesh(mesh, format.value, space=space, metadata=metadata_of(outcome))
    return Response(data, media_type=MESH_MEDIA_TYPES[format], headers=attachment(f"comparison.{format.value}"))
