"""Requests hold what the interface names and nothing else: slips are refused by name, never ignored."""

from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping
from typing import Any, get_origin

from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from starlette.responses import Response

from model.errors import InvalidParameter
from service.routes.multipart import read_form, with_whole_body

#: Longest unknown name that a sentence repeats.
LONGEST_NAME = 64


class StrictRoute(APIRoute):
    """A route that refuses parameters it does not know, those sent twice that are no lists, and bodies cut off."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler behind these checks."""
        handle = super().get_route_handler()
        dependants = list(_flat(self.dependant))
        query = _accepted(field.field_info for one in dependants for field in one.query_params)
        form = _accepted(field.field_info for one in dependants for field in one.body_params)

        async def strict(request: Request) -> Response:
            require_known([name for name, _ in request.query_params.multi_items()], query)
            if not form:
                return await handle(request)
            whole = with_whole_body(request)
            parts = await read_form(whole, request.app.state.services.settings.max_masks)
            try:
                require_known([name for name, _ in parts.multi_items()], form)
            except InvalidParameter:
                await parts.close()
                raise
            return await handle(whole)

        return strict


def require_known(names: Iterable[str], accepted: Mapping[str, bool]) -> None:
    """Refuse the first name that is not accepted, then the first that is sent twice and no list.

    Args:
        accepted: names, and whether each may be sent several times.

    Raises:
        InvalidParameter: one of them.
    """
    sent = list(names)
    for name in sent:
        if name not in accepted:
            raise InvalidParameter(_unknown(name, list(accepted)), part=name)
    for name, is_list in accepted.items():
        if sent.count(name) > 1 and not is_list:
            raise InvalidParameter(
                f"The parameter {name} is sent {sent.count(name)} times; one is accepted.", part=name
            )


def _unknown(name: str, accepted: list[str]) -> str:
    named = f"parameter {name}" if name.isprintable() and 0 < len(name) <= LONGEST_NAME else "such parameter"
    return f"There is no {named}; accepted are: {', '.join(accepted) or 'none'}."


def _flat(dependant: Dependant) -> Iterator[Dependant]:
    yield dependant
    for child in dependant.dependencies:
        yield from _flat(child)


def _accepted(parameters: Iterable[FieldInfo]) -> dict[str, bool]:
    """Names of the interface, and whether each is a list."""
    found: dict[str, bool] = {}
    for parameter in parameters:
        annotation = parameter.annotation
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            raise TypeError(f"{parameter} must be a field of a model, as all parameters of queries and forms are.")
        for name, field in annotation.model_fields.items():
            found[field.alias or name] = get_origin(field.annotation) is list
    return found
