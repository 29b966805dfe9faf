"""``/v1/models``: what is loaded, and what each model says about itself."""

from fastapi import APIRouter, Request

from service import use_cases
from service.presentation import model_description, model_summary
from service.routes.dependencies import WithModel, WithServices, address
from service.routes.responses import problems
from service.routes.strict import StrictRoute
from service.schemas import ModelDescription, ModelList

PATH = "/v1/models"


def models_router() -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=PATH, tags=["models"], route_class=StrictRoute)
    router.add_api_route("", list_models, methods=["GET"], summary="The loaded models", responses=problems(422))
    router.add_api_route(
        "/{model}", describe_model, methods=["GET"], summary="All about one model", responses=problems(404, 422)
    )
    return router


def list_models(request: Request, services: WithServices) -> ModelList:
    """The loaded models in the order of their names."""
    models = use_cases.describe(services.registry)
    return ModelList(models=[model_summary(m, address(request, f"{PATH}/{m.manifest.name}")) for m in models])


def describe_model(request: Request, model: WithModel) -> ModelDescription:
    """Frame, units, latent dimensions, licence, training data and measured accuracy."""
    return model_description(model, address(request, f"{PATH}/{model.manifest.name}"))
