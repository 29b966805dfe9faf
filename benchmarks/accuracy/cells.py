"""One method on one drawing of one case, and the file that keeps what was measured."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from benchmarks.accuracy.drawings import DrawingName
from benchmarks.accuracy.names import MethodName
from benchmarks.json_lines import append_lines, read_lines


@dataclass(frozen=True)
class CellKey:
    """What makes a measurement the same one.

    Attributes:
        digest: of what was learned from data (a bundle, the modes), empty for methods that learn nothing.
        tag: the caller's word, to keep runs of different code apart.
    """

    cohort: str
    case: str
    drawing: DrawingName
    method: MethodName
    digest: str
    tag: str


@dataclass(frozen=True)
class Cell:
    """A measurement.

    Attributes:
        dice, asd_mm, hd95_mm, hd_mm: against the dense mask; NaN when the method refused the drawing.
        fit_s: from the drawing to the fitted parameters; all of ``seconds`` for methods without a fit.
        seconds: from the drawing to the dense mask.
        cpu_s: processor time of ``seconds``, which other programs on the machine disturb less.
        peak_mib: largest resident memory of the method's process meanwhile, its libraries included.
        refusal: why there is no figure, empty otherwise.
    """

    key: CellKey
    dice: float
    asd_mm: float
    hd95_mm: float
    hd_mm: float
    fit_s: float
    seconds: float
    cpu_s: float
    peak_mib: float
    refusal: str = ""

    @property
    def measured(self) -> bool:
        """Whether there are figures."""
        return not self.refusal


class CellFile:
    """JSON lines, one a cell, in the order of measurement; a line cut off by a kill is passed over."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> dict[CellKey, Cell]:
        """All cells; the last one of equal keys."""
        cells = map(_parsed, read_lines(self.path))
        return {cell.key: cell for cell in cells if cell is not None}

    def append(self, cells: Iterable[Cell]) -> None:
        """Add cells and see them written."""
        append_lines(self.path, map(_plain, cells))


def _plain(cell: Cell) -> dict[str, object]:
    values = asdict(cell)
    values = {**values.pop("key"), **values}
    return {name: _written(value) for name, value in values.items()}


def _written(value: object) -> object:
    """Strict JSON has no infinity and no NaN."""
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else "infinite"
    return value


def _parsed(values: Any) -> Cell | None:
    try:
        key = {f.name: values.pop(f.name) for f in fields(CellKey)}
        key |= {"drawing": DrawingName(key["drawing"]), "method": MethodName(key["method"])}
        refusal = str(values.pop("refusal"))
        return Cell(CellKey(**key), **{name: _read(value) for name, value in values.items()}, refusal=refusal)
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def _read(value: float | str | None) -> float:
    return math.nan if value is None else math.inf if value == "infinite" else float(value)
