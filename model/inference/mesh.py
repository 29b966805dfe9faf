"""A triangle mesh with scalars on its vertices."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Mesh:
    """Closed triangle mesh.

    Attributes:
        vertices: (v, 3) mm, world RAS.
        faces: (f, 3) vertex numbers, counter-clockwise seen from outside.
        normals: (v, 3) outward unit normals.
        scalars: named (v,) values, for example ``surface_sd_mm``.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    scalars: dict[str, Float[np.ndarray, "v"]] = field(default_factory=dict)
