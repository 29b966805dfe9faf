"""Which cells a run consists of."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.accuracy.cells import CellKey
from benchmarks.accuracy.drawings import DrawingName
from benchmarks.accuracy.measuring import Task
from benchmarks.accuracy.methods import Sources
from benchmarks.accuracy.names import INTERPOLATIONS, MethodName, reason_against
from model.bundle import read_manifest
from training.baselines.distance_choice import spread
from training.baselines.kept_modes import digest_of
from training.cohorts.cohort import Case

#: Drawings that the predecessor's slow fit is measured on.
ADAM_DRAWINGS = (DrawingName.THIN, DrawingName.THICK, DrawingName.ORTHOGONAL)
#: Slow methods are begun first.
BY_DURATION = tuple(MethodName(name) for name in ("adam", "project", "model-alone", "pca", "itk", "signed-distance"))


@dataclass(frozen=True)
class CohortPlan:
    """A cohort's part of a run.

    Attributes:
        cases: held-out cases, in their order.
        adam_cases: the first of them, on which the predecessor is measured too.
        shippable: whether pictures of the cases may be published.
    """

    name: str
    cases: tuple[Case, ...]
    adam_cases: int
    sources: Sources
    shippable: bool
    attribution: str


def tasks_of(
    plans: Sequence[CohortPlan], drawings: Sequence[DrawingName], methods: Sequence[MethodName], tag: str
) -> list[Task]:
    """All cells, one task a method and cohort, slow methods first."""
    ordered = [method for method in BY_DURATION if method in methods]
    found = [_task(plan, drawings, method, tag) for method in ordered for plan in plans]
    return [task for task in found if task.keys]


def without(tasks: Iterable[Task], there: Iterable[CellKey]) -> list[Task]:
    """The tasks without the cells that are there already."""
    known = set(there)
    left = [Task(t.method, t.sources, tuple(key for key in t.keys if key not in known), t.cases) for t in tasks]
    return [task for task in left if task.keys]


def keys_of(tasks: Iterable[Task]) -> list[CellKey]:
    """All cells of some tasks."""
    return [key for task in tasks for key in task.keys]


def chosen_cases(cases: Sequence[Case], count: int) -> tuple[Case, ...]:
    """So many cases, evenly spaced."""
    return tuple(spread(cases, count))


def _task(plan: CohortPlan, drawings: Sequence[DrawingName], method: MethodName, tag: str) -> Task:
    slow = method is MethodName.ADAM
    cases = plan.cases[: plan.adam_cases] if slow else plan.cases
    taken = [name for name in drawings if not reason_against(method, name) and (not slow or name in ADAM_DRAWINGS)]
    digest = learned_digest(method, plan.sources)
    keys = tuple(CellKey(plan.name, case.name, name, method, digest, tag) for name in taken for case in cases)
    return Task(method, plan.sources, keys, {case.name: case for case in cases})


def learned_digest(method: MethodName, sources: Sources) -> str:
    """Digest of what a method has learned; empty for methods that learn nothing."""
    if method in INTERPOLATIONS:
        return ""
    if method is MethodName.PCA:
        return digest_of(sources.modes)[:16] if sources.modes else ""
    return bundle_digest(sources.bundle)[:16]


def bundle_digest(folder: Path) -> str:
    """SHA-256 of a bundle's manifest, which holds all the others."""
    return read_manifest(folder)[1]
