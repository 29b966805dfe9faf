"""How wide posterior SDs have to be to be right: a factor, and an error that the whole surface shares.

Over answers to sound drawings of validation shapes the volume's error is taken as normal with variance
``(s v)^2 + (b A)^2``: ``v`` the SD by the posterior as it is, ``A`` what the volume gains when the surface moves out by
1 mm. ``s`` and ``b`` are the most probable ones. Before volumes are seen, ``log s`` is expected near the ratio of RMS
error and RMS SD over vertices, and ``b`` near zero; so few shapes cannot lead far astray. Volume alone would not tell
how far a vertex is off, nor the other way round: errors of neighbouring vertices cancel in part.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from training.usual import Sound

#: SD of ``log s`` about the vertices' ratio, and of ``b`` (mm) about zero, before volumes are seen.
LOG_SCALE_SD, OFFSET_SD_MM = 0.2, 0.1
#: Range of ``s`` about that ratio (log) and of ``b`` (mm) that is searched.
LOG_SCALE_REACH, HIGHEST_OFFSET_MM = 0.7, 0.5
STEPS = 101
#: Drawings of one case share most of their error; each counts as so many independent ones.
INDEPENDENT = 0.5


def posterior_scale(sound: Sequence[Sound]) -> dict[str, float]:
    """`Manifest.posterior` of a model."""
    errors, sds = (np.array([getattr(one, name) for one in sound]) for name in ("surface_error_mm", "surface_sd_mm"))
    ratio = float(np.sqrt(np.square(errors).mean() / max(float(np.square(sds).mean()), 1e-12)))
    centre = np.log(np.clip(ratio, 0.25, 4.0))
    logs = centre + np.linspace(-LOG_SCALE_REACH, LOG_SCALE_REACH, STEPS)
    offsets = np.linspace(0.0, HIGHEST_OFFSET_MM, STEPS)
    costs = np.array([[_cost(sound, log, offset, centre) for offset in offsets] for log in logs])
    row, column = np.unravel_index(int(np.argmin(costs)), costs.shape)
    return {
        "sd_scale": round(float(np.exp(logs[row])), 4),
        "offset_mm": round(float(offsets[column]), 4),
        "vertex_ratio": round(ratio, 4),
    }


def _cost(sound: Sequence[Sound], log_scale: float, offset_mm: float, centre: float) -> float:
    """Negative log posterior of the two numbers (nats)."""
    error, sd, swelling = _columns(sound)
    variance = np.square(np.exp(log_scale) * sd) + np.square(offset_mm * swelling) + 1e-12
    data = 0.5 * float(np.sum(np.square(error) / variance + np.log(variance)))
    prior = 0.5 * ((log_scale - centre) / LOG_SCALE_SD) ** 2 + 0.5 * (offset_mm / OFFSET_SD_MM) ** 2
    return INDEPENDENT * data + prior


def _columns(
    sound: Sequence[Sound],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    rows = np.array([[one.volume_error_ml, one.volume_sd_ml, one.swelling_ml] for one in sound])
    return rows[:, 0], rows[:, 1], rows[:, 2]
