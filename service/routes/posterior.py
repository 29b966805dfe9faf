"""``/v1/reconstructions/{id}``: what else the shape could be, and where to draw to know better."""

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from model.interruption import Check
from service import use_cases
from service.adapters.posterior_files import PosteriorWriter
from service.adapters.sample_files import MANIFEST, SampleFile
from service.presentation import next_plane_summary
from service.request_schemas import NextPlaneQuery, PosteriorQuery
from service.routes.archives import ArchiveResponse
from service.routes.connection import run_while_connected
from service.routes.dependencies import ResultId, WithServices, WithStreamTicket, WithTicket
from service.routes.reconstructions import PATH
from service.routes.responses import ZIP, files, problems
from service.routes.strict import StrictRoute
from service.schemas import NextPlaneSchema


def posterior_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=f"{PATH}/{{id}}", tags=["reconstructions"], route_class=StrictRoute)
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
    identifier: ResultId, query: Annotated[PosteriorQuery, Query()], services: WithServices, ticket: WithStreamTicket
) -> Response:
    """Draws of code, pose and discrepancy; of an ensemble its members. Item i is the shape of `seed` + i."""
    limits = services.settings
    seeds = use_cases.batch_seeds(query.seed, query.count, limits.max_samples)
    result = await run_in_threadpool(services.store.load, identifier)
    posterior = use_cases.posterior(services.registry, result.outcome, query.spacing_mm, limits.max_voxels)
    writer = PosteriorWriter(services.write_mesh, query.format)

    def made(check: Check, seed: int) -> SampleFile:
        return writer.make(posterior.checked(check), seed)

    works = (partial(made, seed=seed) for seed in seeds)
    manifest = partial(writer.manifest, posterior, identifier)
    return ArchiveResponse("posterior.zip", ticket, works, manifest, limits.workers + 1)


async def read_next_plane(
    identifier: ResultId,
    query: Annotated[NextPlaneQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> JSONResponse:
    """The plane whose drawing would reduce the expected uncertainty of the surface most, and by how much."""
    result = await run_in_threadpool(services.store.load, identifier)
    work = partial(use_cases.next_plane, services.registry, result.outcome, query.planes)
    found = await run_while_connected(request, ticket, work)
    return JSONResponse(next_plane_summary(result.outcome, found).model_dump(mode="json"))
