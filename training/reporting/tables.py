"""The paper's table: a row a regime and latent size, without and with flow and ARD, the paper beside it."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from training.report import spread
from training.reporting.paper import PaperCell, paper_cell
from training.sweep.priors import PriorName
from training.sweep.summary import correlation
from training.sweep.table import Result

COLUMNS = ("asd_mm", "hd95_mm", "hd_mm", "dice")
TITLES = ("ASD mm", "HD95 mm", "HD mm", "Dice")
SIDES = ((PriorName.PLAIN, "without flow and ARD"), (PriorName.FLOW_ARD, "with flow and ARD"))


@dataclass(frozen=True)
class Line:
    """One row of a cohort's table.

    Attributes:
        trained, measured: regime of the drawings.
        objective: what was minimised.
        figures: by prior and column, mean and SD over cases (and seeds); no entry where no cell was run.
        cases: by prior, how many measurements those are.
        active, correlation: with flow and ARD: counts for 95, 97 and 99 %, and R^2 and r.
        paper: by prior, what the paper has for the same kind of bone.
    """

    cohort: str
    trained: str
    measured: str
    latent_size: int
    objective: str
    figures: dict[PriorName, dict[str, tuple[float, float]]]
    cases: dict[PriorName, int]
    active: tuple[int, ...]
    correlation: tuple[float, float] | None
    paper: dict[PriorName, PaperCell]


def lines_of(results: Sequence[Result]) -> list[Line]:
    """Rows by cohort, regime of training, of measurement, and latent size."""
    keys = {
        (one.cohort, one.objective, _rank(one.regime), _rank(name), one.latent_size, one.regime, name)
        for one in results
        for name in one.measured
    }
    found = [
        _line([one for one in results if (one.cohort, one.objective) == key[:2]], *key[4:]) for key in sorted(keys)
    ]
    return [line for line in found if line.figures]


def paired_difference(results: Sequence[Result], column: str, regime: str) -> tuple[float, float, int] | None:
    """Mean of (with - without flow and ARD) over shapes that both measured, its standard error, and how many shapes."""
    sides = []
    for prior, _ in SIDES:
        mine = [one for one in results if one.prior == prior.value and regime in one.measured]
        sides.append(
            {(one.seed, case): found[column] for one in mine for case, found in one.measured[regime].items() if found}
        )
    shared = sorted(sides[0].keys() & sides[1].keys())
    if not shared:
        return None
    mean, sd = spread([sides[1][key] - sides[0][key] for key in shared])
    return mean, sd / len(shared) ** 0.5, len(shared)


def write_table(lines: Sequence[Line], path: Path) -> None:
    """The rows as CSV; the paper's figures stand in columns that begin with ``paper_``."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        rows = [dict(_flat(line)) for line in lines]
        names = list(dict.fromkeys(name for row in rows for name in row)) or ["cohort"]
        writer = csv.DictWriter(stream, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _line(results: Sequence[Result], size: int, trained: str, measured: str) -> Line:
    mine = [one for one in results if (one.regime, one.latent_size) == (trained, size)]
    cohort, objective = mine[0].cohort, mine[0].objective
    figures: dict[PriorName, dict[str, tuple[float, float]]] = {}
    cases: dict[PriorName, int] = {}
    for prior, _ in SIDES:
        found = [
            values
            for one in mine
            if one.prior == prior.value
            for values in one.measured.get(measured, {}).values()
            if values is not None
        ]
        if found:
            figures[prior] = {name: spread([values[name] for values in found]) for name in COLUMNS}
            cases[prior] = len(found)
    full = next((one for one in mine if one.prior == PriorName.FLOW_ARD.value), None)
    pearson = correlation(full) if full is not None and full.latent else None
    paper = {prior: paper_cell(cohort, measured, size, prior is PriorName.FLOW_ARD) for prior, _ in SIDES}
    return Line(
        cohort,
        trained,
        measured,
        size,
        objective,
        figures,
        cases,
        tuple(full.active) if full is not None else (),
        None if pearson is None else (pearson**2, pearson),
        {prior: cell for prior, cell in paper.items() if cell is not None},
    )


def _flat(line: Line) -> Iterator[tuple[str, object]]:
    yield from zip(
        ("cohort", "trained_on", "measured_in", "latent_size", "objective"),
        (line.cohort, line.trained, line.measured, line.latent_size, line.objective),
        strict=True,
    )
    for prior, _ in SIDES:
        for place, name in enumerate(COLUMNS):
            ours, paper = line.figures.get(prior, {}).get(name), line.paper.get(prior)
            for part, word in enumerate(("mean", "sd")):
                yield f"{prior}_{name}_{word}", "" if ours is None else round(ours[part], 4)
                yield f"paper_{prior}_{name}_{word}", "" if paper is None else paper.figures[place][part]
        yield f"{prior}_cases", line.cases.get(prior, "")
    yield "active_95_97_99", "-".join(map(str, line.active))
    yield "r_squared", "" if line.correlation is None else round(line.correlation[0], 4)
    yield "pearson_r", "" if line.correlation is None else round(line.correlation[1], 4)
    full = line.paper.get(PriorName.FLOW_ARD)
    yield "paper_active_95_97_99", "" if full is None or full.active is None else "-".join(map(str, full.active))
    yield "paper_r_squared", "" if full is None or full.correlation is None else full.correlation[0]
    yield "paper_pearson_r", "" if full is None or full.correlation is None else full.correlation[1]


def _rank(regime: str) -> int:
    return ("thin", "thick", "orthogonal", "dense").index(regime)
