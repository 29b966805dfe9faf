"""Reliability of voxels and vertices, and what following the advice gains, as pictures."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.uncertainty.next_planes import FIRST
from benchmarks.uncertainty.summary import METHODS, Cells, curve_of, reliability_sums, vertices_of

#: Groups of vertices with like SDs.
GROUPS = 12
COLOURS = {"laplace": "#08519c", "ensemble": "#e6550d", "advised": "#08519c", "random": "#7f7f7f"}


def save_diagrams(cells: Cells, cohort: str, path: Path) -> None:
    """Reliability of voxels, error by SD of vertices, and ASD by number of planes where that was looked at."""
    answers = [p for key, p in cells.items() if key.kind == "answer" and key.cohort == cohort]
    mpl.use("Agg")
    curves = _curves_of(cells, cohort)
    count = 3 if curves else 2
    figure = Figure(figsize=(4.0 * count, 4.0), layout="constrained")
    panels = figure.subplots(1, count)
    _reliability(panels[0], answers)
    _errors(panels[1], answers)
    if curves:
        _draw_curves(panels[2], curves)
    figure.suptitle(cohort)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _reliability(panel: Axes, answers: list[dict[str, object]]) -> None:
    panel.plot([0, 1], [0, 1], color="#bdbdbd", linewidth=1)
    for method in METHODS:
        count, expected, found = reliability_sums(answers, method)
        kept = count > 0
        panel.plot(expected[kept] / count[kept], found[kept] / count[kept], "o-", color=COLOURS[method], label=method)
    panel.set(xlabel="probability of a voxel", ylabel="share of such voxels in the object", title="within 5 mm")
    panel.legend()


def _errors(panel: Axes, answers: list[dict[str, object]]) -> None:
    highest = 0.0
    for method in METHODS:
        sd, error = vertices_of(answers, method)
        groups = np.array_split(np.argsort(sd), GROUPS)
        across = [float(np.sqrt(np.square(sd[rows]).mean())) for rows in groups]
        up = [float(np.sqrt(np.square(error[rows]).mean())) for rows in groups]
        highest = max(highest, *across, *up)
        panel.plot(across, up, "o-", color=COLOURS[method], label=method)
    panel.plot([0, highest], [0, highest], color="#bdbdbd", linewidth=1)
    panel.set(xlabel="SD of a vertex (mm)", ylabel="RMS distance from the true surface (mm)", title="vertices")
    panel.legend()


def _curves_of(cells: Cells, cohort: str) -> dict[str, Float[np.ndarray, "n"]]:
    """ASD (mm) by number of planes for each strategy that was followed."""
    curves = {strategy: curve_of(cells, cohort, strategy) for strategy in ("advised", "random")}
    return {strategy: curve for strategy, curve in curves.items() if curve is not None}


def _draw_curves(panel: Axes, curves: dict[str, Float[np.ndarray, "n"]]) -> None:
    for strategy, curve in curves.items():
        panel.plot(FIRST + np.arange(len(curve)), curve, "o-", color=COLOURS[strategy], label=strategy)
    panel.set(xlabel="planes", ylabel="ASD (mm)", title="where to draw next")
    panel.set_ylim(bottom=0.0)
    panel.legend()
