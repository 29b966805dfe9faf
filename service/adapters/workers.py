"""A bounded pool of worker threads: so many run, so many wait, the rest are refused."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import count
from typing import Any, TypeVar

from service.errors import Overloaded

T = TypeVar("T")


class _Ticket:
    """One admitted client; its place is free again when it left and its last work is done."""

    def __init__(self, pool: "WorkerPool") -> None:
        self._pool = pool
        self._pending: set[Future[Any]] = set()

    async def run(self, work: Callable[[], T]) -> T:
        """Result of the work; cancelling the wait takes work that has not begun out of the queue."""
        future = self._pool.submit(work)
        self._pending.add(future)
        try:
            return await asyncio.wrap_future(future)
        finally:
            future.cancel()
            if future.done():
                self._pending.discard(future)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """See `service.ports.Ticket`."""
        self._pool.release()
        try:
            yield
        finally:
            self._pool.take()

    def leave(self) -> None:
        """Free the place, now or as soon as the last thread that still works for it is done."""
        left = list(self._pending)
        remaining = count(len(left) - 1, -1)

        def end(_: object) -> None:
            if next(remaining) == 0:
                self._pool.release()

        for future in left:
            future.add_done_callback(end)
        if not left:
            self._pool.release()


class WorkerPool:
    """The `WorkEngine` of one process.

    Args:
        workers: threads that work at the same time.
        max_waiting: clients that may wait for a thread.
    """

    def __init__(self, workers: int, max_waiting: int) -> None:
        self._workers = workers
        self._capacity = workers + max_waiting
        self._admitted = 0
        self._running = 0
        self._lock = threading.Lock()
        self._executor = ThreadPoolExecutor(workers, thread_name_prefix="worker")

    @contextmanager
    def admit(self) -> Iterator[_Ticket]:
        """A place among running and waiting work; refused with `Overloaded` when all are taken."""
        with self._lock:
            if self._admitted >= self._capacity:
                raise Overloaded("More work is waiting than this service accepts; send the request again later.")
            self._admitted += 1
        ticket = _Ticket(self)
        try:
            yield ticket
        finally:
            ticket.leave()

    def submit(self, work: Callable[[], T]) -> Future[T]:
        """Queue work for the next free thread."""
        return self._executor.submit(self._counted, work)

    def take(self) -> None:
        """Take one place, whether or not there is one."""
        with self._lock:
            self._admitted += 1

    def release(self) -> None:
        """Give one place back."""
        with self._lock:
            self._admitted -= 1

    def waiting(self) -> int:
        """How many admitted clients do not have a worker."""
        return max(0, self._admitted - self._running)

    def running(self) -> int:
        """How many workers are busy."""
        return self._running

    def is_full(self) -> bool:
        """Whether `admit` would refuse."""
        return self._admitted >= self._capacity

    def close(self) -> None:
        """Drop what waits; what runs ends by itself."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _counted(self, work: Callable[[], T]) -> T:
        with self._lock:
            self._running += 1
        try:
            return work()
        finally:
            with self._lock:
                self._running -= 1
