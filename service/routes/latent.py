"""``/v1/reconstructions/{id}``: the latent code as features, and the way to another reconstruction."""

import json
from collections.abc import AsyncIterator
from contextlib import aclosing
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response, StreamingResponse
from zipstream import ZipStream  # type: ignore[import-untyped]

from model.errors import InvalidParameter
from model.inference.latent import LatentFeatures
from service import use_cases
from service.latent_schemas import Features, InterpolationQuery
from service.ports import Outcome, Ticket
from service.routes.connection import in_order, run_while_connected
from service.routes.dependencies import Services, WithServices, WithTicket
from service.routes.meshes import model_metadata
from service.routes.reconstructions import PATH
from service.routes.responses import MESH_MEDIA_TYPES, ZIP, attachment, files, problems
from service.routes.results import Identifier
from service.schemas import ModelReference

MANIFEST = "manifest.json"


def latent_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=f"{PATH}/{{id}}", tags=["reconstructions"])
    router.add_api_route(
        "/features",
        read_features,
        methods=["GET"],
        response_model=Features,
        summary="Latent code of a result, as features",
        responses=problems(404, 503),
    )
    router.add_api_route(
        "/interpolation",
        read_interpolation,
        methods=["GET"],
        response_class=Response,
        summary="Surfaces on the way from a result to another",
        responses={
            200: files([*MESH_MEDIA_TYPES.values(), ZIP], f"a surface; with steps a ZIP, {MANIFEST} last"),
            **problems(404, 413, 422, 503),
        },
    )
    return router


async def read_features(
    identifier: Identifier, request: Request, services: WithServices, ticket: WithTicket
) -> JSONResponse:
    """The code and where it lies in the training population."""
    outcome = (await run_in_threadpool(services.store.load, identifier)).outcome
    found = await run_while_connected(request, ticket, lambda _: _features(services, outcome))
    return JSONResponse(_wire(outcome, found).model_dump(mode="json"))


async def read_interpolation(
    identifier: Identifier,
    query: Annotated[InterpolationQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithTicket,
) -> Response:
    """The straight line in the flow's base, by the model alone, in the world of the first."""
    if query.at is not None and query.steps is not None:
        raise InvalidParameter("The parameters at and steps exclude each other; one is accepted.", part="steps")
    first = (await run_in_threadpool(services.store.load, identifier)).outcome
    other = (await run_in_threadpool(services.store.load, query.other)).outcome
    way = use_cases.way_between(services.registry, first, other, query.spacing_mm, services.settings.max_voxels)
    if query.steps is not None:
        chunks = _zip_chunks(services, way, query, query.steps, ticket)
        return StreamingResponse(chunks, media_type=ZIP, headers=attachment("interpolation.zip"))
    place = 0.5 if query.at is None else query.at
    data = await run_while_connected(request, ticket, lambda _: _bytes(services, way, query, place))
    headers = attachment(f"interpolation.{query.format.value}")
    return Response(data, media_type=MESH_MEDIA_TYPES[query.format], headers=headers)


def _features(services: Services, outcome: Outcome) -> LatentFeatures:
    return use_cases.features(services.registry, outcome, services.modes)


def _wire(outcome: Outcome, found: LatentFeatures) -> Features:
    answer = outcome.reconstruction
    return Features(
        model=ModelReference(name=outcome.model_name, version=outcome.model_version, digest=outcome.model_digest),
        latent=found.latent.tolist(),
        posterior_sd=None if found.posterior_sd is None else found.posterior_sd.tolist(),
        base=found.base.tolist(),
        population_mean=found.population_mean.tolist(),
        population_sd=found.population_sd.tolist(),
        active=found.active.tolist(),
        log_prior_density_nats=answer.log_prior_density,
        typicality_percentile=answer.typicality_percentile,
    )


def _bytes(services: Services, way: use_cases.Way, query: InterpolationQuery, at: float) -> bytes:
    manifest = way.model.manifest
    said = model_metadata(manifest.name, manifest.version, way.model.digest)
    return services.write_mesh(way.shape(at), query.format.value, space=way.space, metadata={**said, "at": f"{at:g}"})


async def _zip_chunks(
    services: Services, way: use_cases.Way, query: InterpolationQuery, steps: int, ticket: Ticket
) -> AsyncIterator[bytes]:
    archive = ZipStream(sized=False)
    places = [number / (steps - 1) for number in range(steps)]
    names = [f"interpolation-{number:02d}.{query.format.value}" for number in range(steps)]
    works = (partial(_bytes, services, way, query, place) for place in places)
    async with aclosing(in_order(ticket, works, services.settings.workers + 1)) as made:
        number = 0
        async for data in made:
            archive.add(data, names[number])
            number += 1
            for chunk in archive.all_files():
                yield chunk
    entries = [{"file": name, "at": place} for name, place in zip(names, places, strict=True)]
    archive.add(json.dumps({"space": way.space, "unit": "mm", "shapes": entries}, indent=1).encode(), MANIFEST)
    for chunk in archive.finalize():
        yield chunk
