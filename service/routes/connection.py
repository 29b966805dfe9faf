"""Work for a client that may go away: what has not begun is dropped, what runs stops at its next evaluation."""

import asyncio
import threading
from collections import deque
from collections.abc import AsyncGenerator, Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import TypeVar

from fastapi import Request

from model.interruption import Check
from service.errors import Abandoned
from service.ports import Ticket

T = TypeVar("T")


#: What a client that is gone would be told.
GONE = "The client went away before the answer was ready."


@contextmanager
def while_wanted() -> Iterator[Check]:
    """A check that lets work pass within the context, and raises `Abandoned` after it."""
    left = threading.Event()

    def check() -> None:
        if left.is_set():
            raise Abandoned(GONE)

    try:
        yield check
    finally:
        left.set()


async def run_while_connected(request: Request, ticket: Ticket, work: Callable[[Check], T]) -> T:
    """Result of the work, given a check that raises `Abandoned` once the client is gone.

    Raises:
        Abandoned: the client went away first.
    """
    with while_wanted() as check:
        task = asyncio.ensure_future(ticket.run(lambda: work(check)))
        listener = asyncio.ensure_future(_disconnected(request))
        try:
            await asyncio.wait({task, listener}, return_when=asyncio.FIRST_COMPLETED)
            if task.done():
                return task.result()
            raise Abandoned(GONE)
        finally:
            task.cancel()
            listener.cancel()


async def in_order(ticket: Ticket, works: Iterable[Callable[[], T]], ahead: int) -> AsyncGenerator[T, None]:
    """Results of works in their order, at most `ahead` of them begun or waiting to be taken; the rest is not begun."""
    begun: deque[asyncio.Future[T]] = deque()
    remaining = iter(works)
    try:
        while True:
            for work in islice(remaining, ahead - len(begun)):
                begun.append(asyncio.ensure_future(ticket.run(work)))
            if not begun:
                return
            yield await begun.popleft()
    finally:
        for future in begun:
            future.cancel()


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
