"""What routes are given: the wired parts of the application, and a place among the work."""

import threading
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Path, Request
from pydantic import AfterValidator

from model.bundle import ShapeModel
from service.errors import UnknownResult
from service.job_ports import BlobStore, JobEngine
from service.model_registry import ModelRegistry
from service.observability import Log, Metrics
from service.ports import (
    Compute,
    MaskReader,
    MeshWriter,
    ModeSource,
    ResultStore,
    StoredResult,
    Ticket,
    VolumeWriter,
    WorkEngine,
)
from service.routes.problems import NamedNotFound
from service.routes.turns import Turns
from service.settings import Settings


@dataclass(frozen=True)
class Services:
    """Everything that a route may use; `create_app` puts it together.

    Attributes:
        closing: set once the server begins to shut down; streams without an end of their own end then.
    """

    settings: Settings
    registry: ModelRegistry
    store: ResultStore
    engine: WorkEngine
    compute: Compute
    read_mask: MaskReader
    write_mesh: MeshWriter
    write_volume: VolumeWriter
    modes: ModeSource
    jobs: JobEngine
    turns: Turns
    blobs: BlobStore
    metrics: Metrics
    log: Log
    closing: threading.Event = field(default_factory=threading.Event)


def services_of(request: Request) -> Services:
    """The services of the application that a request came to."""
    services: Services = request.app.state.services
    return services


def client_of(request: Request) -> str | None:
    """Who sent a request, as far as its key tells (a digest of it); None where no key is asked for."""
    client: str | None = request.scope.get("state", {}).get("client")
    return client


async def admitted(services: Annotated[Services, Depends(services_of)]) -> AsyncIterator[Ticket]:
    """A place among running and waiting work."""
    with services.engine.admit() as ticket:
        yield ticket


def model_in_path(model: str, services: Annotated[Services, Depends(services_of)]) -> ShapeModel:
    """The model that the path names; `UnknownModel` otherwise."""
    return services.registry.get(model)


WithServices = Annotated[Services, Depends(services_of)]
#: Until the answer is made, and until it has been sent; work of the latter kind goes on meanwhile.
WithTicket = Annotated[Ticket, Depends(admitted, scope="function")]
WithStreamTicket = Annotated[Ticket, Depends(admitted, scope="request")]
WithModel = Annotated[ShapeModel, Depends(model_in_path)]
#: The identifier of a result in a path.
ResultId = Annotated[
    str,
    Path(alias="id", description="identifier of the result", json_schema_extra={"format": "uuid"}),
    AfterValidator(str.lower),
]


def address(request: Request, path: str) -> str:
    """Absolute path of a resource as the client sees it, behind a proxy's prefix."""
    return f"{request.scope.get('root_path', '').rstrip('/')}{path}"


def result_of_parameter(services: Services, identifier: str, part: str) -> StoredResult:
    """The result that a parameter names; a problem that names the parameter otherwise."""
    try:
        return services.store.load(identifier)
    except UnknownResult:
        sentence = f"The parameter {part} names no reconstruction that is kept; it may have expired or been deleted."
        raise NamedNotFound(UnknownResult(sentence), part) from None
