"""How wide posterior SDs have to be to be right: a factor, and an error that the whole surface shares.

Over answers to sound drawings of validation shapes, intervals of the volume with SD ``sqrt((s v)^2 + (b A)^2)`` are to
hold the truth as often as they say: ``v`` is the SD by the posterior as it is, ``A`` what the volume gains when the
surface moves out by 1 mm. ``s`` and ``b`` are the most probable ones, by the binomial deviance of the coverage at
several levels, which a single answer that is far off does not decide. Before volumes are seen, ``log s`` is expected
near the RMS ratio of error and SD over vertices, and ``b`` near zero; so few shapes cannot lead far astray. Volume
alone would not tell how far a vertex is off, nor the other way round: errors of neighbouring vertices cancel in part.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from model.inference.estimates import interval_reach
from training.usual import Sound

#: SD of ``log s`` about the vertices' ratio, and of ``b`` (mm) about zero, before volumes are seen.
LOG_SCALE_SD, OFFSET_SD_MM = 0.4, 0.1
#: Range of ``s`` about that ratio (log) and of ``b`` (mm) that is searched.
LOG_SCALE_REACH, HIGHEST_OFFSET_MM = 0.7, 0.5
STEPS = 61
#: Answers whose vertices are further off than this share of all count as that one.
WINSORISED = 0.9
#: Levels at which intervals have to hold the truth as often as they say.
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9)
#: Intervals of one drawing hold the truth together, so each counts as this share of an independent one.
INDEPENDENT = 1.0 / len(LEVELS)

#: Volume errors (mL), their SDs as they are (mL), and what the volumes gain when the surface moves out by 1 mm.
Columns = tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]


def posterior_scale(sound: Sequence[Sound]) -> dict[str, float]:
    """`Manifest.posterior` of a model."""
    errors, sds = (np.array([getattr(one, name) for one in sound]) for name in ("surface_error_mm", "surface_sd_mm"))
    squares = np.square(errors / np.maximum(sds, 1e-6))
    ratio = float(np.sqrt(np.minimum(squares, np.quantile(squares, WINSORISED)).mean()))
    centre = float(np.log(np.clip(ratio, 0.25, 4.0)))
    logs = centre + np.linspace(-LOG_SCALE_REACH, LOG_SCALE_REACH, STEPS)
    offsets = np.linspace(0.0, HIGHEST_OFFSET_MM, STEPS)
    columns = _columns(sound)
    costs = np.array([[_cost(columns, log, offset, centre) for offset in offsets] for log in logs])
    row, column = np.unravel_index(int(np.argmin(costs)), costs.shape)
    return {
        "sd_scale": round(float(np.exp(logs[row])), 4),
        "offset_mm": round(float(offsets[column]), 4),
        "vertex_ratio": round(ratio, 4),
    }


def _coverage(columns: Columns, scale: float, offset_mm: float, level: float) -> float:
    error, sd, swelling = columns
    return float(np.mean(np.abs(error) <= interval_reach(level) * np.hypot(scale * sd, offset_mm * swelling)))


def _cost(columns: Columns, log_scale: float, offset_mm: float, centre: float) -> float:
    """Negative log posterior of the two numbers (nats)."""
    data = sum(_deviance(_coverage(columns, np.exp(log_scale), offset_mm, level), level) for level in LEVELS)
    prior = 0.5 * ((log_scale - centre) / LOG_SCALE_SD) ** 2 + 0.5 * (offset_mm / OFFSET_SD_MM) ** 2
    return INDEPENDENT * len(columns[0]) * data + prior


def _deviance(share: float, level: float) -> float:
    """Divergence (nats) of a share that was found from the one that was said."""
    terms = [(share, level), (1.0 - share, 1.0 - level)]
    return float(sum(found * np.log(found / said) for found, said in terms if found > 0.0))


def _columns(sound: Sequence[Sound]) -> Columns:
    rows = np.array([[one.volume_error_ml, one.volume_sd_ml, one.swelling_ml] for one in sound])
    return rows[:, 0], rows[:, 1], rows[:, 2]
