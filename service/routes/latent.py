"""``/v1/reconstructions/{id}``: the latent code as features, and the way to another reconstruction."""

import json
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from model.errors import InvalidParameter
from model.inference.latent import LatentFeatures
from model.interruption import Check
from service import use_cases
from service.adapters.sample_files import MANIFEST, SampleFile
from service.latent_schemas import Features, InterpolationQuery
from service.ports import Outcome
from service.provenance import metadata_of
from service.routes.archives import ArchiveResponse, MakeFile
from service.routes.connection import run_while_connected
from service.routes.dependencies import (
    ResultId,
    Services,
    WithServices,
    WithStreamTicket,
    WithTicket,
    result_of_parameter,
)
from service.routes.reconstructions import PATH
from service.routes.responses import MESH_MEDIA_TYPES, ZIP, attachment, files, problems
from service.routes.strict import StrictRoute
from service.schemas import ModelReference


def latent_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=f"{PATH}/{{id}}", tags=["reconstructions"], route_class=StrictRoute)
    router.add_api_route(
        "/features",
        read_features,
        methods=["GET"],
        response_model=Features,
        summary="Latent code of a result, as features",
        responses=problems(404, 422, 503),
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
    identifier: ResultId, request: Request, services: WithServices, ticket: WithTicket
) -> JSONResponse:
    """The code and where it lies in the training population."""
    outcome = (await run_in_threadpool(services.store.load, identifier)).outcome
    work = partial(use_cases.features, services.registry, outcome, services.modes)
    found = await run_while_connected(request, ticket, work)
    return JSONResponse(_wire(outcome, found).model_dump(mode="json"))


async def read_interpolation(
    identifier: ResultId,
    query: Annotated[InterpolationQuery, Query()],
    request: Request,
    services: WithServices,
    ticket: WithStreamTicket,
) -> Response:
    """The straight line in the flow's base, by the model alone, in the world of the first."""
    if query.at is not None and query.steps is not None:
        raise InvalidParameter("The parameters at and steps exclude each other; one is accepted.", part="steps")
    first = (await run_in_threadpool(services.store.load, identifier)).outcome
    other = (await run_in_threadpool(result_of_parameter, services, query.other, "with")).outcome
    way = use_cases.way_between(services.registry, first, other, query.spacing_mm, services.settings.max_voxels)
    if query.steps is not None:
        works = _files(services, way, query, query.steps)
        manifest = partial(_manifest, way)
        return ArchiveResponse("interpolation.zip", ticket, works, manifest, services.settings.workers + 1)
    place = 0.5 if query.at is None else query.at
    data = await run_while_connected(request, ticket, partial(_bytes, services, way, query, place))
    headers = attachment(f"interpolation.{query.format.value}")
    return Response(data, media_type=MESH_MEDIA_TYPES[query.format], headers=headers)


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


def _bytes(services: Services, way: use_cases.Way, query: InterpolationQuery, at: float, check: Check) -> bytes:
    metadata = {**metadata_of(way.model), "at": f"{at:g}"}
    return services.write_mesh(way.shape(at, check), query.format.value, space=way.space, metadata=metadata)


def _files(services: Services, way: use_cases.Way, query: InterpolationQuery, steps: int) -> Iterator[MakeFile]:
    """Makers of the surfaces from one end to the other."""

    def made(check: Check, number: int) -> SampleFile:
        name, place = f"interpolation-{number:02d}.{query.format.value}", number / (steps - 1)
        return SampleFile(name, _bytes(services, way, query, place, check), {"file": name, "at": place})

    return (partial(made, number=number) for number in range(steps))


def _manifest(way: use_cases.Way, entries: Sequence[dict[str, Any]]) -> bytes:
    return json.dumps({"space": way.space, "unit": "mm", "shapes": list(entries)}, indent=1).encode()
