"""A training step recorded once as a CUDA graph and replayed from then on.

A step is some hundreds of small kernels, and starting each of them from Python takes longer than running it. A graph
starts them all with one call.
"""

import threading
from collections.abc import Callable

import torch
from torch import Tensor

#: Steps that run as they are before the recording, so that libraries and the optimiser have made what they keep.
WARM_UP = 3
#: One recording at a time in this process: the allocator and the driver are shared.
_RECORDING = threading.Lock()


class RecordedStep:
    """Stands for a step and has its effect: the first calls run it, one records it, all that follow replay the record.

    What changes between calls must be read from tensors that stay where they are, and nothing may wait for the device.

    Attributes:
        step: makes one step and returns its figures, which lie on the device.
        generator: the CUDA random stream that the step draws from; it goes on through replays.
    """

    def __init__(self, step: Callable[[], dict[str, Tensor]], generator: torch.Generator) -> None:
        self._step = step
        self._generator = generator
        self._aside = torch.cuda.Stream(generator.device)
        self._before = WARM_UP
        self._graph: torch.cuda.CUDAGraph | None = None
        self._figures: dict[str, Tensor] = {}

    def __call__(self) -> dict[str, Tensor]:
        """One step; its figures are overwritten by the next call."""
        if self._before > 0:
            self._before -= 1
            return self._run_aside()
        if self._graph is None:
            self._graph = self._record()
        self._graph.replay()
        return self._figures

    def _run_aside(self) -> dict[str, Tensor]:
        here = torch.cuda.current_stream()
        self._aside.wait_stream(here)
        with torch.cuda.stream(self._aside):
            figures = self._step()
        here.wait_stream(self._aside)
        return figures

    def _record(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self._generator)
        with _RECORDING, torch.cuda.graph(graph, stream=self._aside, capture_error_mode="thread_local"):
            self._figures = self._step()
        return graph
