"""Figures that a database or a storage is asked for, told within a bound of time whether it answers or not."""

import math
import threading
import time
from collections.abc import Callable

from service.errors import Overloaded

#: How long (s) a figure is told again before it is asked for anew, and how long an answer is waited for.
FRESH_S, PATIENCE_S = 1.0, 2.0


class Recent:
    """A figure as it was lately, asked for in a thread of its own; NaN when nobody answers in time."""

    def __init__(self, figure: Callable[[], float], patience_s: float = PATIENCE_S) -> None:
        self._figure = figure
        self._patience_s = patience_s
        self._lock = threading.Lock()
        self._answered = threading.Event()
        self._asked_at = float("-inf")
        self._asking = False
        self._value = math.nan

    def __call__(self) -> float:
        """The figure."""
        with self._lock:
            if not self._asking and time.monotonic() >= self._asked_at + FRESH_S:
                self._asking, self._asked_at = True, time.monotonic()
                self._answered.clear()
                threading.Thread(target=self._ask, name="figure", daemon=True).start()
        return self._value if self._answered.wait(self._patience_s) else math.nan

    def _ask(self) -> None:
        value = math.nan
        try:
            value = self._figure()
        except (Overloaded, OSError):
            pass
        finally:
            with self._lock:
                self._value, self._asking = value, False
                self._answered.set()
