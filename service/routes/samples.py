"""``/v1/models/{model}/samples``: synthetic shapes, one or a ZIP that streams while it is made."""

from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import aclosing
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request
from starlette.responses import Response, StreamingResponse
from zipstream import ZipStream  # type: ignore[import-untyped]

from model.bundle import ShapeModel
from model.inference.reconstruction import Watch
from model.inference.surface import require_step
from service import use_cases
from service.adapters.sample_files import MANIFEST, Draw, SampleFile, SampleWriter, make_sample, manifest_bytes
from service.ports import SampleFormat, Ticket
from service.request_schemas import BatchQuery, SampleQuery, Seed
from service.routes.caching import CONDITIONAL, cached, caching_headers, is_held, not_modified
from service.routes.connection import in_order, run_while_connected
from service.routes.dependencies import Services, WithModel, WithServices, WithTicket
from service.routes.models import PATH
from service.routes.responses import ZIP, attachment, files, problems, sample_media_type


def samples_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=f"{PATH}/{{model}}/samples", tags=["samples"])
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
            **cached(files(map(sample_media_type, SampleFormat), "the shape in the model's canonical frame, mm")),
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
    """A pure function of the model's digest, the seed and the query: cacheable for ever."""
    headers = caching_headers(services, model, "sample", seed, query)
    if is_held(request, headers):
        return not_modified(headers)
    how, writer = _draw(services, query), SampleWriter(services.write_mesh, services.write_volume)

    def made(watch: Watch) -> SampleFile:
        return services.compute(make_sample, model, writer, seed, how, check=partial(watch, "evaluation"))

    with services.engine.admit() as ticket:
        file = await run_while_connected(request, ticket, made)
    return Response(file.data, media_type=sample_media_type(query.format), headers=headers | attachment(file.name))


async def read_batch(
    query: Annotated[BatchQuery, Query()], model: WithModel, services: WithServices, ticket: WithTicket
) -> Response:
    """Item i is the shape of `seed` + i, the same as on its own; the manifest comes last."""
    limits = services.settings
    beyond = f" here; a job of kind samples takes up to {limits.max_job_samples}"
    seeds = use_cases.batch_seeds(query.seed, query.count, limits.max_samples, beyond)
    how = _draw(services, query)
    require_step(model, how.spacing_mm, how.max_voxels)
    writer = SampleWriter(services.write_mesh, services.write_volume)
    works = (partial(services.compute, make_sample, model, writer, seed, how) for seed in seeds)
    chunks = _zip_chunks(model, how, works, ticket, services.settings.workers + 1)
    return StreamingResponse(chunks, media_type=ZIP, headers=attachment(f"{model.manifest.name}-samples.zip"))


async def _zip_chunks(
    model: ShapeModel, how: Draw, works: Iterable[Callable[[], SampleFile]], ticket: Ticket, ahead: int
) -> AsyncIterator[bytes]:
    archive = ZipStream(sized=False)
    entries = []
    async with aclosing(in_order(ticket, works, ahead)) as made:
        async for file in made:
            entries.append(file.entry)
            archive.add(file.data, file.name)
            for chunk in archive.all_files():
                yield chunk
    archive.add(manifest_bytes(model, how, entries), MANIFEST)
    for chunk in archive.finalize():
        yield chunk


def _draw(services: Services, query: SampleQuery) -> Draw:
    return Draw(query.format, query.temperature, query.spacing_mm, services.settings.max_voxels, query.reject)
