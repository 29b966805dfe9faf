"""A cohort: masks of one structure, split by person, with what was found on looking at them."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np
from jaxtyping import Bool

from model.errors import CohortError
from model.geometry import Grid

Split = Literal["train", "validation", "test"]
#: Side of masks of which nobody has said any.
NOT_STATED = "not stated"
#: Names that a sentence holds.
NAMED = 3


class SideName(StrEnum):
    """Side convention of a cohort's masks."""

    LEFT = "left"
    RIGHT = "right"
    MIXED = "mixed"
    UNPAIRED = "unpaired"


@dataclass(frozen=True)
class Case:
    """One mask.

    Attributes:
        name: unique within the cohort.
        person: cases of one person are never divided between splits.
        split: train, validation or test.
        mask: (i, j, k) voxels of the object.
        grid: its voxels in the world (RAS mm).
        findings: peculiarities that were seen and let pass, as sentences.
        stored: its voxels in the world before an alignment turned them; None where none did.
    """

    name: str
    person: str
    split: Split
    mask: Bool[np.ndarray, "i j k"]
    grid: Grid
    findings: tuple[str, ...] = ()
    stored: Grid | None = None

    @property
    def volume_ml(self) -> float:
        """Volume of the object's voxels (mL)."""
        return float(self.mask.sum() * np.prod(self.grid.spacing) / 1000.0)


@dataclass(frozen=True)
class Refusal:
    """A case that is left out, and why, as a sentence.

    Attributes:
        name: of the case.
        reason: what is wrong and what would be accepted.
        stops: whether the caller has to agree to go on without it; copies of another case are just left out.
    """

    name: str
    reason: str
    stops: bool = True


@dataclass(frozen=True)
class Provenance:
    """Where masks come from and what may be done with weights trained on them."""

    source: str
    licence: str
    attribution: str
    shippable: bool


@dataclass(frozen=True)
class Cohort:
    """Cases of one structure by split, without the refused ones.

    Attributes:
        name: for example ``hippocampus``.
        train, validation, test: disjoint in persons.
        refused: what was left out.
        provenance: source, licence and attribution.
        side: side convention of the masks: ``left``, ``right``, ``mixed``, ``unpaired`` or ``not stated``.
    """

    name: str
    train: tuple[Case, ...]
    validation: tuple[Case, ...]
    test: tuple[Case, ...]
    refused: tuple[Refusal, ...]
    provenance: Provenance
    side: str = NOT_STATED

    @property
    def cases(self) -> tuple[Case, ...]:
        """All cases: train, validation, test."""
        return self.train + self.validation + self.test

    @property
    def reflects(self) -> bool:
        """Whether mirror images join the training shapes unless a caller says otherwise: where there are no sides.

        Where there are two, mirror images would be a second heap of shapes, with the mean between both.
        """
        return self.side == "unpaired"

    @property
    def recorded_side(self) -> str:
        """Side as runs and manifests hold it: ``mixed`` where none is stated, since both may be among the shapes."""
        return SideName.MIXED.value if self.side == NOT_STATED else self.side

    @property
    def licence(self) -> str:
        """Licence of the masks."""
        return self.provenance.licence

    @property
    def attribution(self) -> str:
        """Whom to name."""
        return self.provenance.attribution

    @property
    def source(self) -> str:
        """Where the masks come from."""
        return self.provenance.source

    def of_split(self, split: Split) -> tuple[Case, ...]:
        """The cases of one split."""
        return {"train": self.train, "validation": self.validation, "test": self.test}[split]


def hold_out(cases: Sequence[Case], *, fraction: float, seed: int, split: Split = "validation") -> tuple[Case, ...]:
    """Move a share of the training persons to another split, all cases of a person together.

    The choice depends on the persons and the seed, not on the order of the cases. One person at the
    least is held out, unless there is only one. Nothing moves when the split exists already. Of one drawing of lots
    the first are for validation and the last for the test, so that whoever asks for a test split only after shapes
    were used for validation does not get these.
    """
    persons = sorted({case.person for case in cases if case.split == "train"})
    if len(persons) < 2 or fraction <= 0 or any(case.split == split for case in cases):
        return tuple(cases)
    count = min(max(1, round(fraction * len(persons))), len(persons) - 1)
    lots = np.random.default_rng(seed).permutation(persons).tolist()
    held = set(lots[-count:] if split == "test" else lots[:count])
    return tuple(
        replace(case, split=split) if case.split == "train" and case.person in held else case for case in cases
    )


def evenly(cases: Sequence[Case], count: int) -> Sequence[Case]:
    """Evenly spaced cases, so many at most."""
    return cases[:: -(-len(cases) // count)]


def divided_persons(cases: Iterable[Case]) -> tuple[str, ...]:
    """Persons who stand in more than one split."""
    splits: dict[str, set[str]] = {}
    for case in cases:
        splits.setdefault(case.person, set()).add(case.split)
    return tuple(sorted(person for person, found in splits.items() if len(found) > 1))


def refusal_error(refused: Sequence[Refusal]) -> CohortError:
    """The error that lists each refused case and why."""
    return CohortError(
        f"{len(refused)} case(s) must not be used: {_reasons(refused)}; --skip-refused goes on without them"
    )


def nothing_left_error(cases: Sequence[Case], refused: Sequence[Refusal]) -> CohortError:
    """The error that no case is left to train on: which splits the others are in, and what was refused."""
    if not (cases or refused):
        return CohortError(
            "No case is left to train on: the cohort holds no masks, NIfTI, NRRD or MetaImage is accepted"
        )
    counts = Counter(case.split for case in cases)
    splits = f"{counts['train']} train, {counts['validation']} validation, {counts['test']} test"
    return CohortError(f"No case is left to train on ({splits}){': ' if refused else ''}{_reasons(refused)}")


def _reasons(refused: Sequence[Refusal]) -> str:
    return "; ".join(f"{refusal.name}: {refusal.reason}" for refusal in refused)


def listed(names: Sequence[str]) -> str:
    """The first names, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")
