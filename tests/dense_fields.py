"""Fields of which only the values at the nodes of a grid are known, and their surfaces."""

import numpy as np
from jaxtyping import Float

from model.inference.isosurface import extract_surface
from model.inference.mesh import Mesh


def surface_of_nodes(values: Float[np.ndarray, "i j k"], lower: Float[np.ndarray, "3"], step_mm: float) -> Mesh:
    """Zero surface of a dense grid, positive inside, every component of it.

    Args:
        values: at nodes ``lower + step_mm * (i, j, k)``.
    """

    def at_nodes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        return np.asarray(values[tuple(np.rint((points - lower) / step_mm).astype(int).T)])

    upper = lower + step_mm * (np.array(values.shape) - 1)
    return extract_surface(at_nodes, lower, upper, step_mm, coarse_factor=1, keep_specks=True)
