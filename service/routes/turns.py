"""Threads of their own for requests that ask for jobs."""

from collections.abc import Callable
from typing import Any, TypeVar

from anyio import CapacityLimiter, fail_after
from anyio.to_thread import run_sync

from service.errors import Overloaded

#: Requests about jobs that are worked on at the same time, and how long (s) the next one waits for its turn.
TURNS, TURN_S = 8, 5.0

T = TypeVar("T")


class Turns:
    """Threads for what asks for jobs, so that a database that does not answer holds up no other request."""

    def __init__(self, count: int = TURNS, wait_s: float = TURN_S) -> None:
        self._turns, self._threads = CapacityLimiter(count), CapacityLimiter(count)
        self._wait_s = wait_s

    async def run(self, call: Callable[..., T], *arguments: Any) -> T:
        """The call's answer.

        Raises:
            Overloaded: all turns were taken for as long as may be waited.
        """
        turn = object()
        try:
            with fail_after(self._wait_s):
                await self._turns.acquire_on_behalf_of(turn)
        except TimeoutError:
            raise Overloaded("Requests about jobs are not answered now; send the request again later.") from None
        try:
            return await run_sync(call, *arguments, limiter=self._threads)
        finally:
            self._turns.release_on_behalf_of(turn)
