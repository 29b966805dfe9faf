"""How a worker ends between what must not be broken off, and leaves its jobs to the next one.

Two processes that follow one job at the same time get into each other's checkpoints, and the loser would wait for an
answer of the other for ever. So whoever follows a job asks here before each step, and lets go of it once the worker
ends.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class Ending(BaseException):
    """The worker ends: a job that it follows stays where it is, for the next worker.

    No `Exception`: DBOS records those as the end of a job.
    """


class Busy:
    """Counts what must not be broken off, and tells everything else that the worker ends."""

    def __init__(self) -> None:
        self._count = 0
        self._taken = False
        self._changed = threading.Condition()
        self._ending = threading.Event()

    @contextmanager
    def one(self) -> Iterator[None]:
        """While the context lasts, the worker does not end, or it ends already."""
        with self._changed:
            if self._ending.is_set():
                raise Ending
            self._count += 1
        try:
            yield
        finally:
            with self._changed:
                self._count -= 1
                self._changed.notify_all()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """As `one`, for one at a time: the others wait for their turn, unless the worker ends."""
        with self._changed:
            self._changed.wait_for(lambda: not self._taken or self._ending.is_set())
            if self._ending.is_set():
                raise Ending
            self._taken = True
        try:
            with self.one():
                yield
        finally:
            with self._changed:
                self._taken = False
                self._changed.notify_all()

    def pause(self, seconds: float) -> None:
        """Let time pass, unless the worker ends."""
        if self._ending.wait(seconds):
            raise Ending

    def end(self, limit_s: float) -> None:
        """Begin nothing more, and wait for what runs, but no longer than so."""
        with self._changed:
            self._ending.set()
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._count == 0, limit_s)
