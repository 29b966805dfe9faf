"""``POST /v1/planes``: what a reconstruction would read of masks, before it is asked for."""

from typing import Annotated

from fastapi import APIRouter, Depends, Form, Request

from model.errors import TooLarge
from model.inference.mask_stack import MaskStack
from service import use_cases
from service.presentation import drawn_planes
from service.request_schemas import PlanesForm, parse_annotated, parse_labels
from service.routes.connection import run_while_connected
from service.routes.dependencies import Services, WithServices, WithTicket
from service.routes.multipart import require_multipart
from service.routes.responses import problems
from service.schemas import DrawnPlanes

PATH = "/v1/planes"


def planes_router() -> APIRouter:
    """The route."""
    router = APIRouter(tags=["reconstructions"])
    router.add_api_route(
        PATH,
        read_planes,
        methods=["POST"],
        dependencies=[Depends(require_multipart)],
        summary="The annotated planes of masks",
        responses=problems(400, 413, 415, 422, 503),
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
    return await run_while_connected(request, ticket, lambda _: _planes(services, form))


def _planes(services: Services, form: PlanesForm) -> DrawnPlanes:
    labels = parse_labels(form.label)
    rule = parse_annotated(form.annotated)
    stacks: list[MaskStack] = []
    for number, mask in enumerate(form.mask):
        stacks += services.read_mask(mask.file, f"mask[{number}]", labels)
    return drawn_planes(tuple(stacks), use_cases.annotated_planes(tuple(stacks), rule))
