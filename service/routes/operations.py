"""``/healthz``, ``/readyz`` and ``/metrics``."""

from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from fastapi import APIRouter, Request
from starlette.responses import JSONResponse, Response

from service.errors import Overloaded
from service.routes.dependencies import WithServices
from service.routes.problems import request_id_of, respond_to
from service.routes.responses import Responses, problems
from service.schemas import BrokenModelSchema, Health, Readiness

METRICS_MEDIA_TYPE = "text/plain; version=1.0.0; charset=utf-8"


def operations_router() -> APIRouter:
    """The routes."""
    router = APIRouter(tags=["operations"])
    router.add_api_route("/healthz", health, methods=["GET"], summary="Whether the process answers")
    ready: Responses = {code: answer for code, answer in problems(503).items() if code == 503}
    router.add_api_route(
        "/readyz",
        readiness,
        methods=["GET"],
        response_model=Readiness,
        summary="Whether work can be accepted",
        responses=ready,
    )
    text = {"description": "Prometheus text format", "content": {"text/plain": {"schema": {"type": "string"}}}}
    router.add_api_route(
        "/metrics",
        metrics,
        methods=["GET"],
        response_class=Response,
        summary="Figures for monitoring",
        responses={200: text, **problems()},
    )
    return router


async def health() -> Health:
    """Answers as long as the process does."""
    return Health()


async def readiness(request: Request, services: WithServices) -> Response:
    """503 when no model is loaded or no more work is accepted; names the models that could not be loaded."""
    models = list(services.registry.names())
    if not models or services.engine.is_full():
        reason = "More work is waiting than this service accepts." if models else "No model is loaded."
        retry_after_s = services.settings.retry_after_s
        return respond_to(Overloaded(reason), request_id=request_id_of(request), retry_after_s=retry_after_s)
    broken = [BrokenModelSchema(name=item.name, reason=item.reason) for item in services.registry.broken]
    return JSONResponse(Readiness(models=models, broken=broken).model_dump(mode="json"))


async def metrics(services: WithServices) -> Response:
    """Requests, latencies of requests and stages, queue and memory."""
    # In a thread beside those of other requests: what holds them up is to be seen here.
    text = await run_sync(services.metrics.exposition, limiter=CapacityLimiter(1))
    return Response(text, media_type=METRICS_MEDIA_TYPE)
