"""A model whose work can be ended from outside: each evaluation of its decoder passes a check first.

All long work, whether fit, ensemble, surface, uncertainty or sampling, is many evaluations of some tenths of a second
at most. So what a check raises ends any of it soon, and none of it has to know of who asks for that.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from model.backends import Decoder
from model.bundle import ShapeModel

#: Called before each evaluation; what it raises ends the work.
Check = Callable[[], None]


def unchecked() -> None:
    """A `Check` that lets everything pass."""


class CheckedDecoder:
    """A `Decoder` that passes a check before each evaluation."""

    def __init__(self, decoder: Decoder, check: Check) -> None:
        self.latent_size = decoder.latent_size
        self._decoder = decoder
        self._check = check

    def logits(self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n"]:
        """See `Decoder`."""
        self._check()
        return self._decoder.logits(latent, points)

    def logits_and_jacobians(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n d"], Float[np.ndarray, "b n 3"]]:
        """See `Decoder`."""
        self._check()
        return self._decoder.logits_and_jacobians(latent, points)

    def logits_and_gradients(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n 3"]]:
        """See `Decoder`."""
        self._check()
        return self._decoder.logits_and_gradients(latent, points)


def interruptible(model: ShapeModel, check: Check) -> ShapeModel:
    """The same model, whose evaluations pass the check first."""
    return replace(model, decoder=CheckedDecoder(model.decoder, check))
