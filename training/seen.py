"""Which shapes a model was trained on: told by digests of their voxels, which stand in its manifest."""

from collections.abc import Sequence

from model.bundle import Manifest
from model.errors import InvalidParameter
from training.cohorts.cohort import Case
from training.cohorts.inspect import voxel_digest, without_specks

#: Hexadecimal digits of a digest that a manifest holds.
DIGITS = 16
#: Cases that a sentence names.
NAMED = 3


def short_digest(case: Case) -> str:
    """First `DIGITS` digits of `voxel_digest`: the same wherever a mask lies, so also after alignment."""
    return voxel_digest(case.mask)[:DIGITS]


def check_unseen(manifest: Manifest, cases: Sequence[Case], measured: str = "validation") -> None:
    """Refuse to measure on shapes of the training; nothing is known of models without digests.

    Args:
        measured: which cases these are, in a word.

    Raises:
        InvalidParameter: the model was trained on one of the cases.
    """
    known = set(manifest.training_masks)
    seen = [case.name for case in cases if known and _is_among(case, known)]
    if seen:
        raise InvalidParameter(
            f"The model was trained on {listed(seen)}, which is to be among the {measured} cases; --seed and "
            "--test-fraction of the training, or a model of train --test-fraction, are accepted.",
            part="cohort",
        )


def check_seen(manifest: Manifest, cases: Sequence[Case]) -> None:
    """Refuse to learn from shapes that the model was not trained on, with which it may be measured.

    Raises:
        InvalidParameter: the model was not trained on one of the cases.
    """
    known = set(manifest.training_masks)
    other = [case.name for case in cases if known and not _is_among(case, known)]
    if other:
        raise InvalidParameter(
            f"The model was not trained on {listed(other)}, which the network would learn from; shapes, --seed and "
            "--test-fraction of the training are accepted.",
            part="cohort",
        )


def listed(names: Sequence[str]) -> str:
    """The first names, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def _is_among(case: Case, digests: set[str]) -> bool:
    """With its specks, or without as masks are trained on."""
    return short_digest(case) in digests or voxel_digest(without_specks(case.mask))[:DIGITS] in digests
