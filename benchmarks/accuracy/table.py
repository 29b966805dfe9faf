"""A run as Markdown: a table a cohort, and a line a target."""

import math
from collections.abc import Iterable, Sequence

from benchmarks.accuracy.drawings import DrawingName
from benchmarks.accuracy.names import MethodName, reason_against
from benchmarks.accuracy.summary import Row
from benchmarks.accuracy.targets import Target

HEAD = ("drawing", "method", "cases", "Dice", "ASD mm", "HD95 mm", "fit s", "s", "MiB", "ASD ratio", "times faster")


def as_markdown(rows: Sequence[Row], targets: Sequence[Target]) -> str:
    """All tables, then the targets."""
    cohorts = list(dict.fromkeys(row.cohort for row in rows))
    parts = [f"### {cohort}\n\n{cohort_table([row for row in rows if row.cohort == cohort])}" for cohort in cohorts]
    if targets:
        parts.append(f"### Targets\n\n{target_table(targets)}")
    return "\n\n".join(parts)


def cohort_table(rows: Sequence[Row]) -> str:
    """One cohort; methods that cannot take a drawing stand there with the reason."""
    methods = list(dict.fromkeys(row.method for row in rows))
    drawings = list(dict.fromkeys(row.drawing for row in rows))
    lines = [_line(HEAD), _line(["---"] * len(HEAD))]
    for drawing in drawings:
        here = {row.method: row for row in rows if row.drawing is drawing}
        for method in (method for method in MethodName if method in methods):
            lines += _method_lines(drawing, method, here.get(method))
    return "\n".join(lines)


def target_table(targets: Iterable[Target]) -> str:
    """What was found beside what had to be reached."""
    lines = [_line(("target", "found", "limit", "")), _line(["---"] * 4)]
    for target in targets:
        bound = f"{'at most' if target.at_most else 'at least'} {target.limit:g}"
        verdict = "reached" if target.reached else "**not reached**"
        lines.append(_line((target.words, _number(target.figure, 2), bound, verdict)))
    return "\n".join(lines)


def _method_lines(drawing: DrawingName, method: MethodName, row: Row | None) -> list[str]:
    if row is not None:
        return [_line(_cells(row))]
    reason = reason_against(method, drawing)
    return [_line([drawing, method.label, f"({reason})", *[""] * (len(HEAD) - 3)])] if reason else []


def _cells(row: Row) -> list[str]:
    counted = str(row.cases) + (f" ({row.refused} refused)" if row.refused else "")
    compared = ["", ""]
    if row.method is not MethodName.PROJECT:
        compared = [_number(row.asd_ratio, 2), _number(row.time_ratio, 1)]
    return [
        row.drawing,
        row.method.label,
        counted,
        *[f"{_number(row.mean[name], 3)} ± {_number(row.deviation[name], 3)}" for name in ("dice", "asd_mm")],
        _number(row.mean["hd95_mm"], 2),
        _number(row.mean["fit_s"], 2),
        _number(row.mean["seconds"], 2),
        _number(row.mean["peak_mib"], 0),
        *compared,
    ]


def _number(value: float, digits: int) -> str:
    if math.isnan(value):
        return "–"
    return "∞" if math.isinf(value) else f"{value:.{digits}f}"


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
