"""What is computed once for each loaded model and kept while it is asked for."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

from model.bundle import ShapeModel

T = TypeVar("T")
#: Models whose value is kept; the one not asked for longest goes first.
KEPT = 16


class PerModel(Generic[T]):
    """A function of a model, computed at the first call for each bundle (by its digest).

    Threads that ask for the same model at the same time wait for one computation. One that fails is tried again.
    """

    def __init__(self, compute: Callable[[ShapeModel], T], kept: int = KEPT) -> None:
        self._compute = compute
        self._kept = kept
        self._values: OrderedDict[str, T] = OrderedDict()
        self._locks: dict[str, threading.Lock] = {}
        self._guard = threading.Lock()

    def __call__(self, model: ShapeModel) -> T:
        """The value for a model."""
        with self._guard:
            lock = self._locks.setdefault(model.digest, threading.Lock())
        with lock:
            with self._guard:
                if model.digest in self._values:
                    self._values.move_to_end(model.digest)
                    return self._values[model.digest]
            value = self._compute(model)
            self._keep(model.digest, value)
            return value

    def _keep(self, digest: str, value: T) -> None:
        with self._guard:
            self._values[digest] = value
            while len(self._values) > self._kept:
                oldest, _ = self._values.popitem(last=False)
                self._locks.pop(oldest, None)
