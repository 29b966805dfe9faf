"""Threads of their own for requests that ask for jobs."""

import asyncio
from collections.abc import Callable
from typing import Any, TypeVar

from anyio import CapacityLimiter, fail_after
from anyio.to_thread import run_sync

from service.errors import Overloaded

#: Requests about jobs that are worked on at the same time, and how long (s) the next one waits for its turn.
TURNS, TURN_S = 8, 5.0
#: How long (s) a turn is waited for that only asks.
ANSWER_S = 8.0

T = TypeVar("T")


class Turns:
    """Threads for what asks for jobs, so that a database that does not answer holds up no other request."""

    def __init__(self, count: int = TURNS, wait_s: float = TURN_S) -> None:
        self._turns, self._threads = CapacityLimiter(count), CapacityLimiter(count)
        self._wait_s = wait_s

    async def run(self, call: Callable[..., T], *arguments: Any, limit_s: float | None = ANSWER_S) -> T:
        """The call's answer; a call that is not waited for any longer keeps its turn until it ends.

        Args:
            limit_s: how long an answer is waited for; as long as it takes when None, for calls that keep what was sent.

        Raises:
            Overloaded: all turns were taken for as long as may be waited, or the call took longer than it may.
        """
        turn = object()
        try:
            with fail_after(self._wait_s):
                await self._turns.acquire_on_behalf_of(turn)
        except TimeoutError:
            raise _no_answer() from None
        task = asyncio.ensure_future(run_sync(call, *arguments, limiter=self._threads))
        task.add_done_callback(lambda ended: self._end(turn, ended))
        await asyncio.wait({task}, timeout=limit_s)
        if not task.done():
            raise _no_answer()
        return task.result()

    def _end(self, turn: object, ended: "asyncio.Future[Any]") -> None:
        self._turns.release_on_behalf_of(turn)
        if not ended.cancelled():
            ended.exception()  # taken note of, whether anybody still waits or not


def _no_answer() -> Overloaded:
    return Overloaded("Requests about jobs are not answered now; send the request again later.")
