"""``POST /v1/planes``: what a reconstruction would read of masks, before it is asked for."""

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Form, Request

from model.errors import TooLarge
from model.interruption import Check
from service import use_cases
from service.presentation import drawn_planes
from service.request_schemas import PlanesForm, parse_annotated, parse_labels
from service.routes.connection import run_while_connected
from service.routes.dependencies import Services, WithServices, WithTicket
from service.routes.masks import masks_of_form
from service.routes.responses import problems
from service.routes.strict import StrictRoute
from service.schemas import DrawnPlanes

PATH = "/v1/planes"


def planes_router() -> APIRouter:
    """The route."""
    router = APIRouter(tags=["reconstructions"], route_class=StrictRoute)
    router.add_api_route(
        PATH,
        read_planes,
        methods=["POST"],
        summary="The annotated planes of masks",
        responses=problems(400, 413, 415, 422, 503, 507),
    )
    return router


async def read_planes(
    request: Request,
    form: Annotated[PlanesForm, Form(media_type="multipart/form-data")],
    services: WithServices,
    ticket: WithTicket,
) -> DrawnPlanes:
    """The planes that a reconstruction with the same parts would use, with what is drawn on them; nothing is kept."""
    if len(form.mask) > services.settings.max_masks:
        raise TooLarge(f"At most {services.settings.max_masks} parts named mask are accepted.", part="mask")
    return await run_while_connected(request, ticket, partial(_planes, services, form))


def _planes(services: Services, form: PlanesForm, check: Check) -> DrawnPlanes:
    labels = parse_labels(form.label)
    rule = parse_annotated(form.annotated)
    stacks = masks_of_form(services, form.mask, labels, check)
    return drawn_planes(stacks, use_cases.annotated_planes(stacks, rule))
