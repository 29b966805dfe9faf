"""ZIP archives that stream while they are made, and whose work ends with the stream."""

from collections.abc import AsyncGenerator, Callable, Iterable
from contextlib import aclosing
from functools import partial
from typing import Any

from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send
from zipstream import ZipStream  # type: ignore[import-untyped]

from model.interruption import Check
from service.adapters.sample_files import MANIFEST, SampleFile
from service.ports import Ticket
from service.routes.connection import in_order, while_wanted
from service.routes.responses import ZIP, attachment

#: Makes one file; passes the check that it is given before each evaluation.
MakeFile = Callable[[Check], SampleFile]


class ArchiveResponse(StreamingResponse):
    """An archive with a manifest as its last member.

    Args:
        works: make the files in their order, some of them ahead of what was sent; one without data is an entry alone.
        manifest: makes the manifest of the files' entries.
        ahead: how many are begun or wait to be sent.
    """

    def __init__(
        self,
        name: str,
        ticket: Ticket,
        works: Iterable[MakeFile],
        manifest: Callable[[list[dict[str, Any]]], bytes],
        ahead: int,
    ) -> None:
        self._chunks = _chunks(ticket, works, manifest, ahead)
        super().__init__(self._chunks, media_type=ZIP, headers=attachment(name))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it; once the client is gone nothing of it is made any more."""
        async with aclosing(self._chunks):
            await super().__call__(scope, receive, send)


async def _chunks(
    ticket: Ticket, works: Iterable[MakeFile], manifest: Callable[[list[dict[str, Any]]], bytes], ahead: int
) -> AsyncGenerator[bytes, None]:
    archive = ZipStream(sized=False)
    entries = []
    with while_wanted() as check:
        async with aclosing(in_order(ticket, (partial(work, check) for work in works), ahead)) as made:
            async for file in made:
                entries.append(file.entry)
                if file.data:
                    archive.add(file.data, file.name)
                for chunk in archive.all_files():
                    yield chunk
    archive.add(manifest(entries), MANIFEST)
    for chunk in archive.finalize():
        yield chunk
