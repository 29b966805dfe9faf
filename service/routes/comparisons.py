"""``/v1/reconstructions/{id}/comparison``: where two results differ, as a signed distance on the surface of one."""

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request
from starlette.responses import Response

from service import use_cases
from service.ports import MeshFormat, StoredResult
from service.request_schemas import ComparisonQuery
from service.routes.connection import run_while_connected
from service.routes.dependencies import Services, WithServices, WithTicket
from service.routes.meshes import model_metadata
from service.routes.reconstructions import PATH
from service.routes.responses import MESH_MEDIA_TYPES, attachment, files, problems

#: Formats that have room for scalars.
SCALAR_FORMATS = (MeshFormat.PLY, MeshFormat.GLB, MeshFormat.VTP, MeshFormat.MZ3)

Identifier = Annotated[
    str, Path(alias="id", description="identifier of the result", json_schema_extra={"format": "uuid"})
]


def comparisons_router() -> APIRouter:
    """The route."""
    router = APIRouter(tags=["reconstructions"])
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
    identifier: Identifier,
    query: Annotated[ComparisonQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> Response:
    """The surface of this result in its input's world, or in `space`.

    The scalar `signed_distance_mm` is positive where it lies outside the other one.
    """
    return await run_while_connected(request, ticket, lambda _: _comparison(services, identifier, query))


def _comparison(services: Services, identifier: str, query: ComparisonQuery) -> Response:
    result: StoredResult = services.store.load(identifier)
    mesh = use_cases.compare(result.outcome, services.store.load(query.other).outcome)
    outcome, format = result.outcome, MeshFormat(query.format)
    metadata = model_metadata(outcome.model_name, outcome.model_version, outcome.model_digest)
    space = query.space or outcome.reconstruction.space
    data = services.write_mesh(mesh, format.value, space=space, metadata=metadata)
    return Response(data, media_type=MESH_MEDIA_TYPES[format], headers=attachment(f"comparison.{format.value}"))
