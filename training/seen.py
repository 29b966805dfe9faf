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
    known = set(manifest.training_masks)
    seen = [case.name for case in cases if known and is_among(case, known)]
    if seen:
        raise InvalidParameter(
            f"The model was trained on {listed(seen)}, which is to be among the {measured} cases; --seed and "
            "--test-fraction of the training, or a model of train --test-fraction, are accepted.",
            part="cohort",
        )


def check_uncalibrated(manifest: Manifest, cases: Sequence[Case]) -> None:
    """Refuse to test on shapes that the model was calibrated on; nothing is known of models without their digests.

    Raises:
        InvalidParameter: it was calibrated on one of the cases.
    """
    masks = manifest.calibration.get("masks")
    known = set(masks) if isinstance(masks, tuple | list) else set()
    seen = [case.name for case in cases if known and is_among(case, known)]
    if seen:
        raise InvalidParameter(
            f"The model was calibrated on {listed(seen)}, which is to be among the test cases; the same --seed and "
            "--test-fraction for train, export, calibrate and evaluate are accepted.",
            part="cohort",
        )


def check_seen(manifest: Manifest, cases: Sequence[Case]) -> None:
    """Refuse to learn from shapes that the model was not trained on, with which it may be measured.

    Raises:
        InvalidParameter: the model was not trained on one of the cases.
    """
    known = set(manifest.training_masks)
    other = [case.name for case in cases if known and not is_among(case, known)]
    if other:
        raise InvalidParameter(
            f"The model was not trained on {listed(other)}, which the network would learn from; shapes, --seed and "
            "--test-fraction of the training are accepted.",
            part="cohort",
        )
