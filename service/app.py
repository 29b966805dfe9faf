"""The one place where the service is wired."""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import AbstractContextManager, AsyncExitStack, asynccontextmanager, nullcontext, suppress
from functools import partial
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from fastapi_offline import FastAPIOffline

from model.inference.modes import shape_modes
from service.adapters.images import write_nifti
from service.adapters.mesh_formats import write_mesh
from service.adapters.per_model import PerModel
from service.adapters.processes import compute_here
from service.adapters.workers import WorkerPool
from service.extras import require_extra
from service.model_registry import ModelRegistry, load_registry
from service.observability import Log, Metrics, going_on, make_log
from service.ports import Compute
from service.routes.comparisons import comparisons_router
from service.routes.dependencies import Services
from service.routes.jobs import jobs_router
from service.routes.latent import latent_router
from service.routes.middleware import AccessMiddleware, BodyLimitMiddleware, HeadMiddleware, KeyMiddleware
from service.routes.models import models_router
from service.routes.modes import modes_router
from service.routes.operations import operations_router
from service.routes.page import page_router
from service.routes.planes import planes_router
from service.routes.posterior import posterior_router
from service.routes.problems import install_handlers
from service.routes.reconstructions import reconstructions_router
from service.routes.redirects import RelativeRedirects
from service.routes.results import results_router
from service.routes.samples import samples_router
from service.routes.stow import stow_router
from service.routes.turns import Turns
from service.schemas import Problem, SurfaceSd
from service.settings import Settings
from service.stores import open_blobs, open_jobs, open_results
from service.wiring import mask_reader

TITLE = "MorphoFlow"
#: Of the interface, not of the program: the second figure rises with additions, the first with breaks.
INTERFACE_VERSION = "1.0.0"
DESCRIPTION = (
    "Complete 3-D anatomy, with its uncertainty, from a few annotated slices. Lengths are mm, coordinates those of the "
    "input's own world, which `space` names: LPS where all masks are DICOM, RAS otherwise. Errors are problems (RFC "
    "9457)."
)


def create_app(
    settings: Settings,
    *,
    registry: ModelRegistry | None = None,
    compute: Compute = compute_here,
    log: Log | None = None,
) -> FastAPI:
    """The application.

    Args:
        settings: everything that an operator may choose.
        registry: the models; those that the settings name when None.
        compute: where reconstructions and samples are computed.
        log: where log entries go; standard error when None.
    """
    engine = WorkerPool(settings.workers, settings.max_waiting)
    log = log or make_log(settings.log_level)
    blobs, jobs = open_blobs(settings), open_jobs(settings, log)
    store = open_results(settings, blobs)
    services = Services(
        settings=settings,
        registry=load_registry(settings) if registry is None else registry,
        store=store,
        engine=engine,
        compute=compute,
        read_mask=mask_reader(settings),
        write_mesh=write_mesh,
        write_volume=write_nifti,
        modes=PerModel(shape_modes),
        jobs=jobs,
        turns=Turns(),
        blobs=blobs,
        metrics=Metrics(engine, jobs),
        log=log,
    )
    pacs = _open_pacs(services)
    app = FastAPIOffline(
        redoc_url=None,
        generate_unique_id_function=operation_name,
        title=TITLE,
        version=INTERFACE_VERSION,
        description=DESCRIPTION,
        lifespan=partial(lifespan, services=services, pacs=pacs, sweep=store.sweep, close=(jobs.close, engine.close)),
    )
    app.state.services = services
    app.state.pacs = pacs
    _add_routes(app)
    install_handlers(app, settings.retry_after_s)
    app.add_middleware(RelativeRedirects)
    app.add_middleware(HeadMiddleware)
    app.add_middleware(BodyLimitMiddleware, max_bytes=settings.max_body_bytes)
    app.add_middleware(KeyMiddleware, keys=settings.keys)
    app.add_middleware(AccessMiddleware, log=services.log, metrics=services.metrics)
    return app


def _open_pacs(services: Services) -> AbstractContextManager[object]:
    """What stands among picture archives while the service runs; nothing where no file is set."""
    if services.settings.pacs_file is None:
        return nullcontext()
    require_extra("pacs", needed_by="MORPHOFLOW_PACS_FILE")
    from service.pacs import open_pacs

    pacs = open_pacs(services.settings, services.settings.pacs_file, services.blobs, services.jobs, services.log)
    services.metrics.watch("morphoflow_dicom_backlog", "Accepted drawings not given back yet", pacs.inbox.backlog)
    services.metrics.watch("morphoflow_dicom_quarantined", "Objects in quarantine", pacs.inbox.quarantined)
    services.metrics.watch("morphoflow_dicom_turned_away", "Associations beyond the limit", pacs.turned_away.count)
    return pacs


def interface_document() -> dict[str, Any]:
    """The interface's description, the same for all settings and models."""
    app = FastAPI(
        title=TITLE, version=INTERFACE_VERSION, description=DESCRIPTION, generate_unique_id_function=operation_name
    )
    _add_routes(app)
    return app.openapi()


def operation_name(route: APIRoute) -> str:
    """Name of an operation in the interface's description."""
    return route.name


def _add_routes(app: FastAPI) -> None:
    for router in (
        reconstructions_router,
        results_router,
        comparisons_router,
        planes_router,
        posterior_router,
        latent_router,
        models_router,
        modes_router,
        samples_router,
        jobs_router,
        stow_router,
        operations_router,
        page_router,
    ):
        app.include_router(router())
    app.openapi = partial(describe, app)  # type: ignore[method-assign]


def describe(app: FastAPI) -> dict[str, Any]:
    """The interface's description (OpenAPI), made once."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        _drop_foreign_errors(document)
        schemas = document["components"]["schemas"]
        for kind in (Problem, SurfaceSd):
            schemas[kind.__name__] = kind.model_json_schema(ref_template="#/components/schemas/{model}")
        document["components"]["securitySchemes"] = {
            "key": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
            "bearer": {"type": "http", "scheme": "bearer"},
        }
        document["security"] = [{}, {"key": []}, {"bearer": []}]
        app.openapi_schema = document
    return app.openapi_schema


def _drop_foreign_errors(document: dict[str, Any]) -> None:
    """Leave out the framework's own validation errors: no route answers with them."""
    for item in document["paths"].values():
        for operation in item.values():
            if "application/json" in operation["responses"].get("422", {}).get("content", {}):
                del operation["responses"]["422"]
    for name in ("HTTPValidationError", "ValidationError"):
        document["components"]["schemas"].pop(name, None)


@asynccontextmanager
async def lifespan(
    _: FastAPI,
    *,
    services: Services,
    pacs: AbstractContextManager[object],
    sweep: Callable[[], int],
    close: Iterable[Callable[[], None]],
) -> AsyncIterator[None]:
    """The service while it runs; at its end all is closed, whatever becomes of one part.

    Args:
        services: the wired parts.
        pacs: what stands among archives.
        sweep: removes expired results, and tells how many.
        close: closes what was opened, the last one first.
    """
    _tell_models("started", services)
    async with AsyncExitStack() as leaving:
        leaving.callback(services.log.info, "stopped")
        for end in close:
            leaving.callback(end)
        leaving.push_async_callback(_cancelled, asyncio.create_task(_keep_up(sweep, services)))
        leaving.enter_context(pacs)
        yield


def _tell_models(event: str, services: Services) -> None:
    for broken in services.registry.broken:
        services.log.error("broken model", model=broken.name, reason=broken.reason)
    services.log.info(event, models=services.registry.names())


async def _cancelled(task: asyncio.Task[None]) -> None:
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task


async def _keep_up(sweep: Callable[[], int], services: Services) -> None:
    """Sweep results and find models anew, turn after turn, whatever becomes of one."""
    while True:
        with going_on(services.log, "the results' folder cannot be swept"):
            if removed := await asyncio.to_thread(sweep):
                services.log.info("expired results removed", count=removed)
        with going_on(services.log, "models cannot be found anew"):
            if await asyncio.to_thread(services.registry.refresh):
                _tell_models("models reloaded", services)
        await asyncio.sleep(services.settings.sweep_interval_s)
