"""ZIP archives that stream while they are made, and whose work ends with the stream."""

import asyncio
from collections.abc import AsyncGenerator, Callable, Iterable
from contextlib import aclosing, suppress
from functools import partial
from typing import Any

from starlette.responses import StreamingResponse
from starlette.types import Message, Receive, Scope, Send
from zipstream import ZipStream  # type: ignore[import-untyped]

from model.interruption import Check
from service.adapters.sample_files import MANIFEST, SampleFile
from service.ports import Ticket
from service.routes.connection import in_order, while_wanted
from service.routes.responses import ZIP, attachment

#: Makes one file; passes the check that it is given before each evaluation.
MakeFile = Callable[[Check], SampleFile]
#: A client that takes nothing for so long (s) is taken for gone.
STALLED_S = 120.0


class _Stalled(Exception):
    """The client takes nothing any more."""


class ArchiveResponse(StreamingResponse):
    """An archive with a manifest as its last member.

    Args:
        ticket: its place is another's while the client takes what was made, however slowly.
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
        self._ticket = ticket
        self._chunks = _chunks(ticket, works, manifest, ahead)
        super().__init__(self._chunks, media_type=ZIP, headers=attachment(name))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it; once the client is gone nothing of it is made any more."""

        async def sent(message: Message) -> None:
            with self._ticket.aside():
                try:
                    await asyncio.wait_for(send(message), STALLED_S)
                except TimeoutError:
                    raise _Stalled from None

        async with aclosing(self._chunks):
            with suppress(_Stalled):  # the server ends the connection, as what was begun is not whole
                await super().__call__(scope, receive, sent)


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
