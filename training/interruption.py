"""Ctrl-C during a training: the step under way is finished, and a checkpoint can be written before all ends."""

import signal
import threading
from types import TracebackType


class Stopped(KeyboardInterrupt):
    """A training was interrupted between two steps.

    Args:
        step: of `steps` that were made, all of them in the checkpoint.
    """

    def __init__(self, step: int, steps: int) -> None:
        super().__init__(f"stopped at step {step} of {steps}")
        self.step = step
        self.steps = steps


class Interruption:
    """Holds the first interrupt back; the second one acts as without it. Does nothing outside the main thread.

    Attributes:
        came: whether there was an interrupt.
    """

    def __init__(self) -> None:
        self.came = False

    def __enter__(self) -> "Interruption":
        self._before = signal.getsignal(signal.SIGINT)
        self._acts = threading.current_thread() is threading.main_thread() and callable(self._before)
        if self._acts:
            signal.signal(signal.SIGINT, self._see)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._acts:
            signal.signal(signal.SIGINT, self._before)

    def _see(self, *_: object) -> None:
        self.came = True
        signal.signal(signal.SIGINT, self._before)

    def stop_at(self, step: int, steps: int) -> None:
        """End here if there was an interrupt and steps are left.

        Raises:
            Stopped: that is so.
        """
        if self.came and step < steps:
            raise Stopped(step, steps)
