"""Work on models spread over processes: one call computes here, each further one at the same time in a helper.

Most of a fit is short steps that hold the interpreter's lock, so that two threads of one process answer hardly more
requests than one. A helper opens the models for itself, gets arguments and gives back results through a pipe, and ends
when the pipe does. One that dies costs the call that it worked on, and another one takes its place.
"""

import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from queue import PriorityQueue
from typing import Any, Protocol, TypeVar

from threadpoolctl import threadpool_limits

from model.bundle import ShapeModel
from model.errors import MorphoFlowError
from model.inference.reconstruction import Watch, unwatched
from model.interruption import Check, unchecked
from service.errors import Abandoned, HelperLost
from service.observability import Log

T = TypeVar("T")
#: How often (s) a call asks whether its answer is still wanted.
CHECK_S = 0.05
#: A helper that was told to end has ended after so long (s), one way or the other.
LEAVE_WITHIN_S = 5.0
#: A helper that ends before it has opened its models is followed by another one after a pause (s), then a longer one.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
#: First word of a message from a helper.
_READY, _STAGE, _RESULT, _FAULT, _UNKNOWN = "ready", "stage", "result", "fault", "unknown"
_SPAWN = get_context("spawn")


class Models(Protocol):
    """Models that are found again while the program runs."""

    def of_digest(self, digest: str) -> ShapeModel | None:
        """The model of these contents."""
        ...

    def refresh(self) -> bool:
        """Find them anew; whether anything changed."""
        ...


#: Opens a helper's models; goes to it through a pipe.
OpenModels = Callable[[], Models]


def compute_here(
    work: Callable[..., T], model: ShapeModel, *arguments: object, watch: Watch = unwatched, check: Check = unchecked
) -> T:
    """The `Compute` of the calling thread."""
    return work(model, *arguments, watch=watch, check=check)


@dataclass(order=True)
class _Seat:
    """Where one call at a time computes: here when there is no helper; the first is preferred."""

    rank: int
    helper: "_Helper | None" = field(default=None, compare=False)


class Processes:
    """The `Compute` of this process and of helpers; as many calls at a time as it has seats, the others wait.

    Args:
        helpers: how many.
        open_models: opens a helper's models.
        log: where the loss of a helper is told; nowhere when None.
    """

    def __init__(self, helpers: int, open_models: OpenModels, log: Log | None = None) -> None:
        self._open_models = open_models
        self._log = log
        self._seats: PriorityQueue[_Seat] = PriorityQueue()
        self._seats.put(_Seat(0))
        self._helpers: set[_Helper] = set()
        self._lock = threading.Lock()
        self._closed = threading.Event()
        for rank in range(1, helpers + 1):
            self._begin(rank)

    def __call__(
        self,
        work: Callable[..., T],
        model: ShapeModel,
        *arguments: object,
        watch: Watch = unwatched,
        check: Check = unchecked,
    ) -> T:
        """See `Compute`.

        Raises:
            HelperLost: the helper died, for example for want of memory.
        """
        seat = self._seats.get()
        try:
            if seat.helper is not None and (done := seat.helper.call(work, model, arguments, watch, check)):
                answer: T = done.value
                return answer
            return work(model, *arguments, watch=watch, check=check)
        finally:
            if seat.helper is None or seat.helper.alive:
                self._seats.put(seat)
            else:
                self._lose(seat.rank, seat.helper)
                self._begin(seat.rank)

    def free(self) -> int:
        """How many more calls could compute now."""
        return self._seats.qsize()

    def close(self) -> None:
        """End the helpers."""
        with self._lock:
            self._closed.set()
            helpers = tuple(self._helpers)
        for helper in helpers:
            helper.close()

    def _begin(self, rank: int) -> None:
        """Start a helper; it gets its seat once it has opened its models."""
        helper = self._started(rank)
        threading.Thread(target=self._seat, args=(rank, helper), name=f"helper-{rank}", daemon=True).start()

    def _seat(self, rank: int, helper: "_Helper | None") -> None:
        """Wait for a helper; for another one, after ever longer pauses, if it ends before it has opened its models."""
        pause_s = FIRST_PAUSE_S
        while helper is None or not helper.is_ready():
            if helper is not None:
                self._lose(rank, helper)
            if self._closed.wait(pause_s):
                return
            helper, pause_s = self._started(rank), min(2 * pause_s, LONGEST_PAUSE_S)
        self._seats.put(_Seat(rank, helper))

    def _started(self, rank: int) -> "_Helper | None":
        """A new helper; none when all are to end, or the system has no room for another process."""
        with self._lock:
            if self._closed.is_set():
                return None
            try:
                helper = _Helper(self._open_models)
            except OSError as fault:
                self._tell("helper cannot be started", rank, exc_info=fault)
                return None
            self._helpers.add(helper)
            return helper

    def _lose(self, rank: int, lost: "_Helper") -> None:
        with self._lock:
            self._helpers.discard(lost)
        status = lost.close()
        if not self._closed.is_set():
            self._tell("helper ended and is started again", rank, status=status, exc_info=lost.fault)

    def _tell(self, event: str, rank: int, **more: object) -> None:
        if self._log is not None:
            self._log.warning(event, helper=rank, **more)


@contextmanager
def spread(helpers: int, open_models: OpenModels, log: Log | None = None) -> Iterator[Processes]:
    """Processes while the context lasts."""
    processes = Processes(helpers, open_models, log)
    try:
        yield processes
    finally:
        processes.close()


@dataclass(frozen=True)
class _Done:
    """A result that may be anything, None too."""

    value: Any


class _Helper:
    """A process that works, seen from the one that it works for."""

    def __init__(self, open_models: OpenModels) -> None:
        self._connection, there = _SPAWN.Pipe()
        self._unwanted = _SPAWN.RawValue("b", 0)
        self._process = _SPAWN.Process(target=_help, args=(there, self._unwanted, open_models), daemon=True)
        self._process.start()
        there.close()
        self._opening, self._opened = threading.Lock(), False
        self.alive = True
        #: What it met while it opened its models, where it could still tell.
        self.fault: Exception | None = None

    def is_ready(self) -> bool:
        """Wait until its models are open; False when it ended before."""
        with self._opening, suppress(EOFError, OSError):
            kind, *content = self._connection.recv()
            self._opened = kind == _READY
            self.fault = None if self._opened else _unpacked(*content)
        return self._opened

    def call(
        self, work: Callable[..., T], model: ShapeModel, arguments: tuple[object, ...], watch: Watch, check: Check
    ) -> _Done | None:
        """What the work gives; None when the helper does not have this model, or died before it was asked."""
        try:
            self._through(lambda: self._connection.send((work, model.digest, arguments)))
        except HelperLost:
            return None
        try:
            kind, *content = self._last_word(watch, check)
        except HelperLost:
            raise
        except BaseException:  # nobody waits any more: the helper is to stop, and its last word must not stay behind
            self._unwanted.value = 1
            self._last_word(unwatched, unchecked)
            self._unwanted.value = 0
            raise
        if kind == _FAULT:
            raise _unpacked(*content)
        return _Done(content[0]) if kind == _RESULT else None

    def _last_word(self, watch: Watch, check: Check) -> tuple[Any, ...]:
        while True:
            while not self._through(lambda: self._connection.poll(CHECK_S)):
                check()
            message: tuple[Any, ...] = self._through(self._connection.recv)
            if message[0] != _STAGE:
                return message
            watch(message[1])

    def _through(self, use: Callable[[], T]) -> T:
        """What the use of the pipe gives; `HelperLost` when nobody is at its other end."""
        try:
            return use()
        except (EOFError, OSError):
            self.alive = False
            raise HelperLost("The process that computed the answer ended; send the request again.") from None

    def close(self) -> int | None:
        """End it; its exit status."""
        self.alive = False
        self._unwanted.value = 1
        if not self._opened:
            self._process.kill()
        with self._opening:
            self._connection.close()
        self._process.join(LEAVE_WITHIN_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        return self._process.exitcode


def _packed(fault: Exception) -> tuple[type[Exception], tuple[Any, ...], dict[str, Any]]:
    """An error as it goes through a pipe, with where it arose if that is of interest."""
    if not isinstance(fault, MorphoFlowError):
        fault = RuntimeError(traceback.format_exc())
    return type(fault), fault.args, vars(fault)


def _unpacked(kind: type[Exception], arguments: tuple[Any, ...], more: dict[str, Any]) -> Exception:
    fault = kind.__new__(kind, *arguments)
    vars(fault).update(more)
    return fault


def _help(connection: Connection, unwanted: Any, open_models: OpenModels) -> None:
    """The helper's own side: answer call after call until the pipe ends."""
    for number in (signal.SIGINT, signal.SIGTERM):  # who holds the other end decides
        signal.signal(number, signal.SIG_IGN)
    threadpool_limits(limits=1, user_api="blas")
    with suppress(EOFError, OSError):
        try:
            models = open_models()
        except Exception as fault:  # noqa: BLE001 - it is told where the helper was asked for
            connection.send((_FAULT, *_packed(fault)))
            return
        connection.send((_READY,))
        while True:
            _answer(connection, unwanted, models)


def _answer(connection: Connection, unwanted: Any, models: Models) -> None:
    """Answer one call."""
    work, digest, arguments = connection.recv()

    def check() -> None:
        if unwanted.value:
            raise Abandoned("The answer is not wanted any more.")

    try:
        model = models.of_digest(digest) or (models.of_digest(digest) if models.refresh() else None)
        if model is None:
            connection.send((_UNKNOWN,))
        else:
            result = work(model, *arguments, watch=lambda stage: connection.send((_STAGE, stage)), check=check)
            connection.send((_RESULT, result))
    except Exception as fault:  # noqa: BLE001 - it is raised where the work was asked for
        connection.send((_FAULT, *_packed(fault)))
