"""``/v1/reconstructions/{id}``: what else the shape could be, and where to draw to know better."""

from collections.abc import AsyncIterator
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response, StreamingResponse
from zipstream import ZipStream  # type: ignore[import-untyped]

from service import use_cases
from service.adapters.posterior_files import PosteriorWriter
from service.adapters.sample_files import MANIFEST
from service.ports import Ticket
from service.presentation import next_plane_summary
from service.request_schemas import NextPlaneQuery, PosteriorQuery
from service.routes.connection import run_while_connected
from service.routes.dependencies import WithServices, WithTicket
from service.routes.reconstructions import PATH
from service.routes.responses import ZIP, attachment, files, problems
from service.routes.results import Identifier
from service.schemas import NextPlaneSchema
from service.use_cases import Posterior


def posterior_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=f"{PATH}/{{id}}", tags=["reconstructions"])
    router.add_api_route(
        "/posterior",
        read_posterior,
        methods=["GET"],
        response_class=Response,
        summary="Shapes that the result could also be",
        responses={
            200: files([ZIP], f"one mesh a shape, in the input's world, mm; {MANIFEST} comes last"),
            **problems(404, 413, 422, 503),
        },
    )
    router.add_api_route(
        "/next-plane",
        read_next_plane,
        methods=["GET"],
        response_model=NextPlaneSchema,
        summary="Where to draw next",
        responses=problems(404, 422, 503),
    )
    return router


async def read_posterior(
    identifier: Identifier, query: Annotated[PosteriorQuery, Query()], services: WithServices, ticket: WithTicket
) -> Response:
    """Draws of code, pose and discrepancy; of an ensemble its members. Item i is the shape of `seed` + i."""
    limits = services.settings
    seeds = use_cases.batch_seeds(query.seed, query.count, limits.max_samples)
    result = await run_in_threadpool(services.store.load, identifier)
    posterior = use_cases.posterior(services.registry, result.outcome, query.spacing_mm, limits.max_voxels)
    writer = PosteriorWriter(services.write_mesh, query.format)
    chunks = _zip_chunks(posterior, seeds, writer, identifier, ticket)
    return StreamingResponse(chunks, media_type=ZIP, headers=attachment("posterior.zip"))


async def _zip_chunks(
    posterior: Posterior, seeds: range, writer: PosteriorWriter, identifier: str, ticket: Ticket
) -> AsyncIterator[bytes]:
    archive = ZipStream(sized=False)
    entries = []
    for seed in seeds:
        file = await ticket.run(partial(writer.make, posterior, seed))
        entries.append(file.entry)
        if file.data:
            archive.add(file.data, file.name)
        for chunk in archive.all_files():
            yield chunk
    archive.add(writer.manifest(posterior, identifier, entries), MANIFEST)
    for chunk in archive.finalize():
        yield chunk


async def read_next_plane(
    identifier: Identifier,
    query: Annotated[NextPlaneQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> JSONResponse:
    """The plane whose drawing would reduce the expected uncertainty of the surface most, and by how much."""
    result = await run_in_threadpool(services.store.load, identifier)
    found = await run_while_connected(
        request, ticket, lambda _: use_cases.next_plane(services.registry, result.outcome, query.planes)
    )
    return JSONResponse(next_plane_summary(result.outcome, found).model_dump(mode="json"))
