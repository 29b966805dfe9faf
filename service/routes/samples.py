"""``/v1/models/{model}/samples``: synthetic shapes, one or a ZIP that streams while it is made."""

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request
from starlette.responses import Response

from model.inference.surface import require_step
from model.interruption import Check
from service import use_cases
from service.adapters.sample_files import MANIFEST, Draw, SampleFile, SampleWriter, make_sample, manifest_bytes
from service.ports import SampleFormat
from service.request_schemas import BatchQuery, SampleQuery, Seed
from service.routes.archives import ArchiveResponse
from service.routes.caching import CONDITIONAL, cached, caching_headers, confirmed, is_held, not_modified
from service.routes.connection import run_while_connected
from service.routes.dependencies import Services, WithModel, WithServices, WithStreamTicket
from service.routes.models import PATH
from service.routes.responses import ZIP, attachment, files, problems, sample_media_type
from service.routes.strict import StrictRoute


def samples_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=f"{PATH}/{{model}}/samples", tags=["samples"], route_class=StrictRoute)
    router.add_api_route(
        "",
        read_batch,
        methods=["GET"],
        response_class=Response,
        summary="A batch of synthetic shapes",
        responses={200: files([ZIP], f"one file a shape; {MANIFEST} comes last"), **problems(404, 413, 422, 503)},
    )
    router.add_api_route(
        "/{seed}",
        read_sample,
        methods=["GET"],
        response_class=Response,
        summary="One synthetic shape",
        responses={
            **cached(
                files(map(sample_media_type, SampleFormat), "the shape in the model's canonical frame, mm"),
                lasting=True,
            ),
            **problems(404, 413, 422, 503),
        },
        openapi_extra=CONDITIONAL,
    )
    return router


async def read_sample(
    seed: Annotated[Seed, Path()],
    query: Annotated[SampleQuery, Query()],
    request: Request,
    model: WithModel,
    services: WithServices,
) -> Response:
    """A pure function of the model's digest, the seed and the query: cacheable for ever.

    Name the model with its version where a cache must not give the shape of an older one.
    """
    headers = caching_headers(services, model, "sample", seed, query, lasting=True)
    if is_held(request, headers):
        return not_modified(headers)
    how, writer = _draw(services, query), SampleWriter(services.write_mesh, services.write_volume)

    def made(check: Check) -> SampleFile:
        return services.compute(make_sample, model, writer, seed, how, check=check)

    with services.engine.admit() as ticket:
        file = await run_while_connected(request, ticket, made)
    headers |= attachment(file.name)
    return confirmed(request, Response(file.data, media_type=sample_media_type(query.format), headers=headers))


async def read_batch(
    query: Annotated[BatchQuery, Query()], model: WithModel, services: WithServices, ticket: WithStreamTicket
) -> Response:
    """Item i is the shape of `seed` + i, the same as on its own; the manifest comes last.

    Its `nearest_training_distance` is not in mm: it is a distance between latent codes, in standard deviations of the
    flow's base.
    """
    limits = services.settings
    beyond = f" here; a job of kind samples takes up to {limits.max_job_samples}"
    seeds = use_cases.batch_seeds(query.seed, query.count, limits.max_samples, beyond)
    how = _draw(services, query)
    require_step(model, how.spacing_mm, how.max_voxels)
    writer = SampleWriter(services.write_mesh, services.write_volume)

    def made(check: Check, seed: int) -> SampleFile:
        return services.compute(make_sample, model, writer, seed, how, check=check)

    works = (partial(made, seed=seed) for seed in seeds)
    manifest = partial(manifest_bytes, model, how)
    return ArchiveResponse(f"{model.manifest.name}-samples.zip", ticket, works, manifest, limits.workers + 1)


def _draw(services: Services, query: SampleQuery) -> Draw:
    return Draw(query.format, query.temperature, query.spacing_mm, services.settings.max_voxels, query.reject)
