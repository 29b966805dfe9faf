"""Gradients of fields that are splines of lattice values."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

#: Step of the differences (mm).
STEP_MM = 0.02


def differences(
    field: Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]],
    points: Float[np.ndarray, "n 3"],
    here: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n 3"]:
    """Gradient (the field's unit by mm) at points (mm) where the field has these values, by forward differences."""
    return np.stack([field(points + step) - here for step in STEP_MM * np.eye(3)], axis=1) / STEP_MM
