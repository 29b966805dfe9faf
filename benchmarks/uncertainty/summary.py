"""Cells of a run brought together: the figures that were set out to be reached."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import rankdata, spearmanr

from benchmarks.uncertainty.cells import Key, Payload
from benchmarks.uncertainty.next_planes import FIRST

#: A vertex is off when it is farther than this from the true surface (mm).
OFF_MM = 2.0
METHODS = ("laplace", "ensemble")
#: Those whose SDs of vertices are compared: the scatter of an ensemble's refits alone is that of the paper.
SPREADS = (*METHODS, "refits")
#: Distance from the truth's anti-aliased surface.
SMOOTH = "smooth_error_mm"
#: Draws that tell which correlation SDs would have with errors drawn from themselves.
IDEAL_DRAWS = 20

Cells = dict[Key, Payload]


@dataclass(frozen=True)
class Line:
    """A figure beside the range that was to be reached.

    Attributes:
        scope: cohort and drawing.
        words: what was measured.
        found: the figure.
        low, high: what had to be reached, None where it is open.
        digits: decimals to show.
    """

    scope: str
    words: str
    found: float
    low: float | None = None
    high: float | None = None
    digits: int = 3

    @property
    def reached(self) -> bool | None:
        """Whether it was; None without a target. A figure that does not exist was not."""
        if self.low is None and self.high is None:
            return None
        value = round(self.found, self.digits)
        return bool((self.low is None or value >= self.low) and (self.high is None or value <= self.high))


def lines_of(cells: Cells) -> list[Line]:
    """Every figure whose cells are there: for each cohort and drawing, and over all."""
    answers = {key: payload for key, payload in cells.items() if key.kind == "answer"}
    scopes = sorted({(key.cohort, key.regime) for key in answers})
    lines: list[Line] = []
    for cohort, regime in scopes:
        chosen = [p for key, p in answers.items() if (key.cohort, key.regime) == (cohort, regime)]
        lines += _answer_lines(f"{cohort}, {regime}, {len(chosen)} shapes", chosen)
    if len(scopes) > 1:
        lines += _answer_lines(f"all, {len(answers)} answers", list(answers.values()))
    return lines + _next_plane_lines(cells) + _stranger_lines(cells) + _gold_lines(cells)


def _answer_lines(scope: str, answers: Sequence[Payload]) -> list[Line]:
    spearman, area = ({m: figure(answers, m) for m in SPREADS} for figure in (spearman_of, auc_of))
    held = {level: _held(answers, "volume", level) for level in ("0.9", "0.5")}
    seconds = {name: np.array([p["seconds"][name] for p in answers]) for name in ("fit", *METHODS)}
    shares = {name: float(seconds[name].sum() / seconds["fit"].sum()) for name in METHODS}
    return [
        Line(scope, "90 % volume intervals that hold the truth", held["0.9"], 0.85, 0.95, 2),
        Line(scope, "50 % volume intervals that hold the truth", held["0.5"], 0.42, 0.58, 2),
        Line(scope, "90 % volume intervals of the ensemble", _held(answers, "ensemble_volume", "0.9"), digits=2),
        Line(scope, "expected calibration error of voxels", calibration_error(answers, "laplace"), None, 0.03),
        Line(scope, "the same of the ensemble", calibration_error(answers, "ensemble")),
        Line(scope, "Spearman of vertex SD and error", spearman["laplace"], 0.5),
        Line(scope, "the same of SDs with errors drawn from them", ideal_spearman(answers)),
        Line(
            scope, "the same beside the truth without the stairs of its voxels", spearman_of(answers, "laplace", SMOOTH)
        ),
        Line(scope, "Spearman less that of refits alone", spearman["laplace"] - spearman["refits"], 0.0),
        Line(scope, "Spearman less the ensemble's", spearman["laplace"] - spearman["ensemble"]),
        Line(scope, "ROC area for vertices off by over 2 mm", area["laplace"], 0.85),
        Line(scope, "ROC area less that of refits alone", area["laplace"] - area["refits"], 0.0),
        Line(scope, "ROC area less the ensemble's", area["laplace"] - area["ensemble"]),
        Line(scope, "time of Laplace, in fits", shares["laplace"], None, 0.5, 2),
        Line(scope, "time of the ensemble, in fits", shares["ensemble"], None, 8.0, 1),
    ]


def _held(answers: Sequence[Payload], figure: str, level: str) -> float:
    """Share of answers whose interval of a level holds the truth."""
    return float(np.mean([p[figure]["held"][level] for p in answers]))


def reliability_sums(answers: Iterable[Payload], method: str) -> Float[np.ndarray, "3 b"]:
    """Number of voxels, sum of probabilities, and number of true voxels in each bin."""
    rows = [[p["voxels"][method][name] for name in ("count", "expected", "found")] for p in answers]
    return np.asarray(np.sum(rows, axis=0), float)


def calibration_error(answers: Iterable[Payload], method: str) -> float:
    """Expected calibration error (Guo et al. 2017)."""
    count, expected, found = reliability_sums(answers, method)
    return float(np.abs(expected - found).sum() / count.sum())


def vertices_of(
    answers: Iterable[Payload], method: str, error: str = "error_mm"
) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v"]]:
    """SDs and errors (mm) of the vertices of all answers."""
    kept = [(p["vertices"][method], p["vertices"][error]) for p in answers]
    return np.concatenate([sd for sd, _ in kept]), np.concatenate([error for _, error in kept])


def spearman_of(answers: Iterable[Payload], method: str, error: str = "error_mm") -> float:
    """Rank correlation of SD and error over the vertices of all answers."""
    return float(spearmanr(*vertices_of(answers, method, error)).statistic)


def ideal_spearman(answers: Iterable[Payload]) -> float:
    """Rank correlation that Laplace's SDs would have were errors drawn from normal distributions with them."""
    sd, _ = vertices_of(answers, "laplace")
    random = np.random.default_rng(0)
    found = [spearmanr(sd, np.abs(sd * random.standard_normal(len(sd)))).statistic for _ in range(IDEAL_DRAWS)]
    return float(np.mean(found))


def auc_of(answers: Iterable[Payload], method: str) -> float:
    """Area under the receiver operating characteristic of SD for vertices that are off; NaN when none is."""
    sd, error = vertices_of(answers, method)
    return _auc(sd, error > OFF_MM)


def _auc(score: Float[np.ndarray, "n"], positive: Bool[np.ndarray, "n"]) -> float:
    ones = int(positive.sum())
    zeros = len(positive) - ones
    if not ones or not zeros:
        return float("nan")
    return float((rankdata(score)[positive].sum() - ones * (ones + 1) / 2) / (ones * zeros))


def curve_of(cells: Cells, cohort: str, strategy: str) -> Float[np.ndarray, "c"] | None:
    """Mean ASD (mm) from `FIRST` planes on, None without cells."""
    found = [
        p["asd_mm"]
        for key, p in cells.items()
        if key.kind == "next-plane" and key.cohort == cohort and key.regime == strategy
    ]
    return np.mean(found, axis=0) if found else None


def _next_plane_lines(cells: Cells) -> list[Line]:
    lines = []
    for cohort in sorted({key.cohort for key in cells if key.kind == "next-plane"}):
        advised, random = (curve_of(cells, cohort, name) for name in ("advised", "random"))
        if advised is not None and random is not None:
            scope = f"{cohort}, from {FIRST} to {FIRST + len(random) - 1} planes"
            saved = planes_saved(advised, random)
            lines.append(Line(scope, "planes saved by next-plane at the same ASD", saved, 0.3, None, 2))
    return lines


def planes_saved(advised: Float[np.ndarray, "c"], random: Float[np.ndarray, "c"]) -> float:
    """Share of planes that are not needed to come as near as random ones do in the end.

    Negative where the last advised plane is not enough, as far as it was followed.
    """
    last = FIRST + len(random) - 1
    for count, (before, after) in enumerate(pairwise(advised), start=FIRST):
        if after <= random[-1]:
            part = 0.0 if before <= random[-1] else (before - random[-1]) / (before - after)
            return float(1.0 - (count + part) / last)
    return float(random[-1] / advised[-1] - 1.0)


def _gold_lines(cells: Cells) -> list[Line]:
    lines = []
    for cohort in sorted({key.cohort for key in cells if key.kind == "gold"}):
        found = [p for key, p in cells.items() if key.kind == "gold" and key.cohort == cohort]
        figures = [
            *((f"{name}: median SD of a vertex by NUTS's", [p["sd_ratio"][name] for p in found]) for name in METHODS),
            *((f"{name}: correlation of SDs", [p["sd_correlation"][name] for p in found]) for name in METHODS),
            ("laplace: volume SD by NUTS's", [p["volume_sd_ratio"] for p in found]),
            ("mean of NUTS off the fit, in SDs (RMS)", [p["mean_off_in_sds"] for p in found]),
            ("draws of NUTS within Laplace's 50 % interval", [p["inside"]["0.5"] for p in found]),
            ("draws of NUTS within Laplace's 90 % interval", [p["inside"]["0.9"] for p in found]),
        ]
        scope = f"{cohort}, {len(found)} drawings beside NUTS"
        lines += [Line(scope, words, float(np.mean(values)), digits=2) for words, values in figures]
    return lines


def _stranger_lines(cells: Cells) -> list[Line]:
    found: dict[tuple[str, str], list[bool]] = {}
    for key, payload in cells.items():
        if key.kind == "stranger":
            kind = key.subject.partition(":")[0]
            found.setdefault((key.cohort, kind), []).append(bool(payload["unlike"]))
    lines = []
    for cohort in sorted({cohort for cohort, _ in found}):
        strange = [flag for (name, kind), flags in found.items() if name == cohort and kind != "own" for flag in flags]
        scope = f"{cohort} model, {len(strange)} drawings"
        lines.append(Line(scope, "strange shapes called unlike", float(np.mean(strange)), 0.95, None, 3))
    for (cohort, kind), flags in sorted(found.items()):
        own = kind == "own"
        scope = f"{cohort} model, {len(flags)} drawings"
        limits = (None, 0.05) if own else (0.95, None)
        lines.append(Line(scope, f"{'own shapes' if own else kind} called unlike", float(np.mean(flags)), *limits))
    return lines
