"""From files or arrays to an inspected cohort: the steps that all cohorts share."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from model.errors import CohortError
from training.cohorts.cohort import (
    NOT_STATED,
    Case,
    Cohort,
    Provenance,
    Refusal,
    divided_persons,
    hold_out,
    listed,
    nothing_left_error,
    refusal_error,
)
from training.cohorts.inspect import copies, findings_of, out_of_range, outliers, without_specks


@dataclass(frozen=True)
class CohortOptions:
    """How a cohort is put together.

    Attributes:
        seed: of the choice of validation persons.
        validation_fraction: share of the training persons held out.
        test_fraction: share of the persons held out for measuring where the cohort has no test split.
        skip_refused: go on without the refused cases; otherwise any refusal ends in `CohortError`.
        shippable_only: only cases from which weights may be shipped.
    """

    seed: int = 0
    validation_fraction: float = 0.2
    test_fraction: float = 0.0
    skip_refused: bool = False
    shippable_only: bool = False


def assemble(
    name: str,
    cases: Sequence[Case],
    refused: Sequence[Refusal],
    provenance: Provenance,
    options: CohortOptions,
    *,
    side: str = NOT_STATED,
) -> Cohort:
    """Inspect, refuse, clean and split.

    Specks are taken off the training and validation masks; test masks stay as they are.

    Raises:
        CohortError: a case is refused and `skip_refused` is off, no training case is left, or a person
            stands in two splits.
    """
    filled = [case for case in cases if case.mask.any()]
    empty = [Refusal(case.name, "it holds no foreground") for case in cases if not case.mask.any()]
    found = _merged([*refused, *empty, *out_of_range(filled), *copies(filled), *outliers(filled)])
    left_out = {refusal.name for refusal in found}
    kept = [_inspected(case) for case in filled if case.name not in left_out]
    if not any(case.split == "train" for case in kept):
        raise nothing_left_error(kept, found)
    stopping = [refusal for refusal in found if refusal.stops]
    if stopping and not options.skip_refused:
        raise refusal_error(stopping)
    return _split(Cohort(name, tuple(kept), (), (), tuple(found), provenance, side), options)


def _inspected(case: Case) -> Case:
    findings = case.findings + findings_of(case.mask)
    mask = case.mask if case.split == "test" else without_specks(case.mask)
    return replace(case, mask=mask, findings=findings)


def _merged(refused: Iterable[Refusal]) -> list[Refusal]:
    by_name: dict[str, list[Refusal]] = {}
    for refusal in refused:
        by_name.setdefault(refusal.name, []).append(refusal)
    return [
        Refusal(name, "; ".join(one.reason for one in found), stops=any(one.stops for one in found))
        for name, found in by_name.items()
    ]


def _split(cohort: Cohort, options: CohortOptions) -> Cohort:
    cases = hold_out(cohort.train, fraction=options.test_fraction, seed=options.seed, split="test")
    cases = hold_out(cases, fraction=options.validation_fraction, seed=options.seed)
    divided = divided_persons(cases)
    if divided:
        raise CohortError(
            f"{len(divided)} person(s) stand in more than one split ({listed(divided)}); each person is accepted in "
            "one split only."
        )
    train, validation, test = (
        tuple(case for case in cases if case.split == split) for split in ("train", "validation", "test")
    )
    return replace(cohort, train=train, validation=validation, test=test)
