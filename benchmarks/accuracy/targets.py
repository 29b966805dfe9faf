"""What the project sets out to reach, and whether a run reached it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.accuracy.drawings import DrawingName
from benchmarks.accuracy.names import INTERPOLATIONS, MethodName
from benchmarks.accuracy.summary import Row, row_of

#: ASD at most this many times the best interpolation's, from thin and from thick slices.
PARALLEL_LIMITS = {"hippocampus": 0.4, "talus": 0.65, "vertebra": 0.65, "femur": 0.85, "adrenal": 1.0}
#: ASD at most this many times ITK's from orthogonal slices.
ORTHOGONAL_LIMIT = 0.25
#: Times faster than the predecessor.
SPEED_LIMIT = 200.0
#: Ratios are compared after rounding to so many digits.
DIGITS = 3


@dataclass(frozen=True)
class Target:
    """A figure beside its limit.

    Attributes:
        words: what was measured, for example ``femur, thin: ASD by best interpolation's (ITK contours)``.
        figure: what was found.
        limit: what had to be reached.
        at_most: whether the figure must not be above the limit; not below it otherwise.
    """

    words: str
    figure: float
    limit: float
    at_most: bool = True

    @property
    def reached(self) -> bool:
        """Whether it was; a figure that does not exist was not."""
        if math.isnan(self.figure):
            return False
        value = round(self.figure, DIGITS)
        return value <= self.limit if self.at_most else value >= self.limit


def targets_of(rows: Sequence[Row]) -> list[Target]:
    """Every target whose methods were measured."""
    cohorts = list(dict.fromkeys(row.cohort for row in rows))
    found: list[Target] = []
    for cohort in cohorts:
        found += _parallel(rows, cohort)
        found += _orthogonal(rows, cohort)
        found += _modes(rows, cohort)
        found += _predecessor(rows, cohort)
    return found


def _parallel(rows: Sequence[Row], cohort: str) -> list[Target]:
    limit = PARALLEL_LIMITS.get(cohort, 1.0)
    found = []
    for drawing in (DrawingName.THIN, DrawingName.THICK):
        others = [row for method in INTERPOLATIONS if (row := row_of(rows, cohort, drawing, method))]
        if others and row_of(rows, cohort, drawing, MethodName.PROJECT):
            best = min(others, key=lambda row: row.mean["asd_mm"])
            words = f"{cohort}, {drawing}: ASD by the best interpolation's ({best.method.label})"
            found.append(Target(words, best.asd_ratio, limit))
    return found


def _orthogonal(rows: Sequence[Row], cohort: str) -> list[Target]:
    row = row_of(rows, cohort, DrawingName.ORTHOGONAL, MethodName.ITK)
    words = f"{cohort}, orthogonal: ASD by ITK's"
    return [Target(words, row.asd_ratio, ORTHOGONAL_LIMIT)] if row else []


def _modes(rows: Sequence[Row], cohort: str) -> list[Target]:
    others = [row for drawing in DrawingName if (row := row_of(rows, cohort, drawing, MethodName.PCA))]
    return [Target(f"{cohort}, {row.drawing}: ASD by PCA's", row.asd_ratio, 1.0) for row in others]


def _predecessor(rows: Sequence[Row], cohort: str) -> list[Target]:
    others = [row for drawing in DrawingName if (row := row_of(rows, cohort, drawing, MethodName.ADAM))]
    found = []
    for row in others:
        where = f"{cohort}, {row.drawing}, {row.cases} case(s)"
        found += [
            Target(f"{where}: ASD by the predecessor's", row.asd_ratio, 1.0),
            Target(f"{where}: fit, times faster than the predecessor's", row.fit_ratio, SPEED_LIMIT, at_most=False),
            Target(f"{where}: drawing to mask, times faster", row.time_ratio, SPEED_LIMIT, at_most=False),
        ]
    return found
