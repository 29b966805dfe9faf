"""Which shapes a model was trained on: told by digests of their voxels, which stand in its manifest.

Digests are of the shape in the world as it was stored, before any alignment (`shape_digest`). Manifests and runs from
before that hold digests of the bare array (`voxel_digest`), which are looked for as well.
"""

from collections.abc import Collection, Sequence

from model.bundle import Manifest
from model.errors import InvalidParameter
from training.cohorts.cohort import Case, listed
from training.cohorts.inspect import nearest_ras, shape_digest, voxel_digest, without_specks

#: Hexadecimal digits of a digest that a manifest holds.
DIGITS = 16


def short_digest(case: Case) -> str:
    """First `DIGITS` digits of `shape_digest`: the same wherever a mask lies, so also after alignment."""
    return shape_digest(case.mask, case.stored or case.grid)[:DIGITS]


def is_among(case: Case, digests: Collection[str]) -> bool:
    """Whether a case is one of those with these digests: with its specks, or without as masks are trained on."""
    grid = case.stored or case.grid
    return any(
        digest[:DIGITS] in digests
        for mask in (case.mask, without_specks(case.mask))
        for digest in (shape_digest(mask, grid), voxel_digest(mask), voxel_digest(nearest_ras(mask, grid)[0]))
    )


def check_unseen(manifest: Manifest, cases: Sequence[Case], measured: str = "validation") -> None:
    """Refuse to measure on shapes of the training; nothing is known of models without digests.

    Args:
        measured: which cases these are, in a word.

    Raises:
        InvalidParameter: the model was trained on one of the cases.
    """
    _refuse(
        _known(manifest.training_masks, cases),
        f"The model was trained on {{}}, which is to be among the {measured} cases; --seed and --test-fraction of the "
        "training, or a model of train --test-fraction, are accepted.",
    )


def check_uncalibrated(manifest: Manifest, cases: Sequence[Case]) -> None:
    """Refuse to test on shapes that the model was calibrated on; nothing is known of models without their digests.

    Raises:
        InvalidParameter: it was calibrated on one of the cases.
    """
    masks = manifest.calibration.get("masks")
    _refuse(
        _known(masks if isinstance(masks, tuple | list) else (), cases),
        "The model was calibrated on {}, which is to be among the test cases; the same --seed and --test-fraction for "
        "train, export, calibrate and evaluate are accepted.",
    )


def check_seen(manifest: Manifest, cases: Sequence[Case]) -> None:
    """Refuse to learn from shapes that the model was not trained on, with which it may be measured.

    Raises:
        InvalidParameter: the model was not trained on one of the cases.
    """
    known = set(_known(manifest.training_masks, cases))
    other = [case.name for case in cases if manifest.training_masks and case.name not in known]
    _refuse(
        other,
        "The model was not trained on {}, which the network would learn from; shapes, --seed and --test-fraction of "
        "the training are accepted.",
    )


def _known(digests: Collection[str], cases: Sequence[Case]) -> list[str]:
    """Names of the cases that are among those with these digests."""
    looked_up = set(digests)
    return [case.name for case in cases if looked_up and is_among(case, looked_up)]


def _refuse(names: Sequence[str], sentence: str) -> None:
    if names:
        raise InvalidParameter(sentence.format(listed(names)), part="cohort")
