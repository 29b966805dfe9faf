"""What is wrong or peculiar with a mask, alone and beside its cohort.

Refused: nothing in it, a copy of another case, a size that anatomy in mm has not, a size or a voxel spacing that does
not belong to the cohort.
Kept with a finding: specks, several large parts, an object that the crop cuts off, thick slices.
"""

import hashlib
from collections.abc import Sequence
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from model.geometry import Grid
from training.cohorts.cohort import Case, Refusal

#: Parts without a common face count as apart; smaller than this share of the largest, a part is a speck.
SPECK_FRACTION = 0.05
#: Share of neighbouring occupied slices that must be equal before a mask is said to come from thick slices:
#: slices at least 1.4 times as thick as the grid's.
THICK_SHARE = 0.3
#: Extents that anatomy in mm has.
EXTENT_RANGE_MM = (2.0, 2000.0)
#: A case is an outlier beyond this many robust standard deviations (1.4826 MAD) of the logarithm.
OUTLIER_LIMIT = 8.0
#: Least robust standard deviation of log size, so that nothing within a factor of 2.2 is ever refused.
LEAST_SIZE_SPREAD = 0.1
#: The same for log spacing: a factor of 2.
LEAST_SPACING_SPREAD = float(np.log(2.0)) / OUTLIER_LIMIT
#: Spacings are told apart by hundredths of a mm; where one ends and the next begins (a share of it) no usual spacing
#: lies, so that rounding does not tell equal ones apart.
SPACING_STEP_MM, SPACING_BORDER = 0.01, 0.382
#: With fewer cases than this nothing can be called an outlier.
LEAST_CASES = 3

_MAD_TO_SD = 1.4826


def bounding_box(mask: Bool[np.ndarray, "i j k"]) -> tuple[slice, slice, slice]:
    """Smallest box of voxels around the foreground, which must not be empty."""
    first, second, third = (np.flatnonzero(mask.any(axis=other)) for other in ((1, 2), (0, 2), (0, 1)))
    return (
        slice(int(first[0]), int(first[-1]) + 1),
        slice(int(second[0]), int(second[-1]) + 1),
        slice(int(third[0]), int(third[-1]) + 1),
    )


def part_sizes(mask: Bool[np.ndarray, "i j k"]) -> tuple[int, ...]:
    """Voxels of each face-connected part, largest first."""
    labelled, _ = ndimage.label(mask[bounding_box(mask)])
    return tuple(sorted(np.bincount(labelled.ravel())[1:].tolist(), reverse=True))


def without_specks(mask: Bool[np.ndarray, "i j k"]) -> Bool[np.ndarray, "i j k"]:
    """The mask without parts smaller than `SPECK_FRACTION` of the largest one."""
    box = bounding_box(mask)
    labelled, count = ndimage.label(mask[box])
    if count == 1:
        return mask
    sizes = np.bincount(labelled.ravel())
    sizes[0] = 0
    cleaned = np.zeros_like(mask)
    cleaned[box] = (sizes >= SPECK_FRACTION * sizes.max())[labelled] & mask[box]
    return cleaned


def findings_of(mask: Bool[np.ndarray, "i j k"]) -> tuple[str, ...]:
    """Sentences on specks, large parts, borders and thick slices of a mask that is not empty."""
    found = (_specks(mask), _large_parts(mask), _borders(mask), _thick_slices(mask))
    return tuple(sentence for sentence in found if sentence)


def cut_faces(mask: Bool[np.ndarray, "i j k"]) -> Bool[np.ndarray, "2 3"]:
    """Which faces of the crop the object reaches: the first voxels along each axis, and the last ones."""
    return np.array([[mask.take(index, axis=axis).any() for axis in range(3)] for index in (0, -1)])


def touches_border(mask: Bool[np.ndarray, "i j k"]) -> bool:
    """Whether the object reaches the first or the last voxel along any axis of the crop."""
    return _borders(mask) != ""


def _specks(mask: Bool[np.ndarray, "i j k"]) -> str:
    sizes = part_sizes(mask)
    specks = [size for size in sizes[1:] if size < SPECK_FRACTION * sizes[0]]
    return f"{len(specks)} speck(s) apart from the main part, {sum(specks)} voxel(s) in all" if specks else ""


def _large_parts(mask: Bool[np.ndarray, "i j k"]) -> str:
    sizes = part_sizes(mask)
    large = sum(size >= SPECK_FRACTION * sizes[0] for size in sizes)
    return f"{large} large parts that do not touch" if large > 1 else ""


def _borders(mask: Bool[np.ndarray, "i j k"]) -> str:
    faces = int(cut_faces(mask).sum())
    return f"the object touches {faces} face(s) of the crop and may be cut off" if faces else ""


def _thick_slices(mask: Bool[np.ndarray, "i j k"]) -> str:
    shares = [equal_neighbours(mask, axis) for axis in range(3)]
    axis = int(np.argmax(shares))
    if shares[axis] < THICK_SHARE:
        return ""
    return f"{shares[axis]:.0%} of neighbouring slices along axis {axis} are equal: drawn on thicker slices"


def equal_neighbours(mask: Bool[np.ndarray, "i j k"], axis: int) -> float:
    """Share of neighbouring slices, both with foreground, that are equal along an axis."""
    slices = np.moveaxis(mask[bounding_box(mask)], axis, 0)
    occupied = np.asarray(slices.any(axis=(1, 2)))
    both = occupied[1:] & occupied[:-1]
    equal = (slices[1:] == slices[:-1]).all(axis=(1, 2))
    return float((equal & both).sum() / max(int(both.sum()), 1))


def copies(cases: Sequence[Case]) -> tuple[Refusal, ...]:
    """All but one of the cases whose objects have exactly the same voxels in the world, wherever they lie in it.

    The one that stays is of the test split if any is, then of validation, so that no measured shape is trained on.
    """
    order = {"test": 0, "validation": 1, "train": 2}
    kept: dict[str, str] = {}
    refused = []
    for case in sorted(cases, key=lambda case: order[case.split]):
        key = shape_digest(case.mask, case.grid)
        if key in kept:
            refused.append(Refusal(case.name, f"it is the same mask as {kept[key]}, which is kept", stops=False))
        kept.setdefault(key, case.name)
    return tuple(refused)


def shape_digest(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> str:
    """SHA-256 over the object's voxels and their size, wherever it lies and in whatever order its axes are stored.

    Axes are brought to run nearest to R, A and S, so that a mirror image has another digest. The mask must not be
    empty.
    """
    turned, spacing = nearest_ras(mask, grid)
    size = np.floor(spacing / SPACING_STEP_MM + SPACING_BORDER).astype(int).tolist()
    return hashlib.sha256(f"{size} {voxel_digest(turned)}".encode()).hexdigest()


def nearest_ras(
    mask: Bool[np.ndarray, "i j k"], grid: Grid
) -> tuple[Bool[np.ndarray, "a b c"], Float[np.ndarray, "3"]]:
    """Voxels and their spacing (mm), axes permuted and reversed so that they run nearest to R, A and S."""
    along = grid.directions
    first, second, third = max(
        permutations(range(3)), key=lambda axes: sum(abs(along[world, axis]) for world, axis in enumerate(axes))
    )
    axes = (first, second, third)
    steps = tuple(slice(None, None, 1 if along[world, axis] > 0 else -1) for world, axis in enumerate(axes))
    return mask.transpose(axes)[steps], grid.spacing[list(axes)]


def voxel_digest(mask: Bool[np.ndarray, "i j k"]) -> str:
    """SHA-256 over the object's voxels as they are stored, of any size; the mask must not be empty."""
    cropped = mask[bounding_box(mask)]
    return hashlib.sha256(repr(cropped.shape).encode() + np.packbits(cropped).tobytes()).hexdigest()


def extent_mm(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> float:
    """Longest side (mm) of the smallest box of voxels around the foreground, which must not be empty."""
    return float(_extent(mask, grid).max())


def out_of_range(cases: Sequence[Case]) -> tuple[Refusal, ...]:
    """Cases that are longer or shorter than anything in a body, as masks are whose voxels are given in metres."""
    low, high = EXTENT_RANGE_MM
    lengths = {case.name: extent_mm(case.mask, case.grid) for case in cases}
    return tuple(
        Refusal(
            name,
            f"the object is {length:.3g} mm long; {low:g} to {high:g} mm is accepted: are the voxels given in mm?",
        )
        for name, length in lengths.items()
        if not low <= length <= high
    )


def outliers(cases: Sequence[Case]) -> tuple[Refusal, ...]:
    """Cases whose spacing, volume or extent lies far outside the rest of the cohort, with reasons in words."""
    if len(cases) < LEAST_CASES:
        return ()
    measures = (
        ("voxel spacing", "mm", np.stack([_sorted_spacing(case.grid) for case in cases]), LEAST_SPACING_SPREAD),
        ("volume", "mL", np.array([[case.volume_ml] for case in cases]), LEAST_SIZE_SPREAD),
        ("extent", "mm", np.stack([_sorted_extent(case) for case in cases]), LEAST_SIZE_SPREAD),
    )
    reasons: dict[str, list[str]] = {}
    for name, unit, values, least in measures:
        usual = f"where the cohort's median is {_words(np.median(values, axis=0))} {unit}"
        for case, value, deviation in zip(cases, values, robust_deviations(values, least).max(axis=1), strict=True):
            if deviation > OUTLIER_LIMIT:
                sentence = f"{name} {_words(value)} {unit} {usual} ({deviation:.0f} robust standard deviations away)"
                reasons.setdefault(case.name, []).append(sentence)
    head = "it does not belong to the cohort: "
    return tuple(Refusal(name, head + ", ".join(found)) for name, found in reasons.items())


def robust_deviations(values: Float[np.ndarray, "n m"], least: float) -> Float[np.ndarray, "n m"]:
    """Distance of each logarithm from the median in robust standard deviations, none below ``least``."""
    logs = np.log(values)
    gaps = np.abs(logs - np.median(logs, axis=0))
    return np.asarray(gaps / np.maximum(_MAD_TO_SD * np.median(gaps, axis=0), least))


def _sorted_spacing(grid: Grid) -> Float[np.ndarray, "3"]:
    return np.asarray(np.sort(grid.spacing))


def _sorted_extent(case: Case) -> Float[np.ndarray, "3"]:
    return np.asarray(np.sort(_extent(case.mask, case.grid)))


def _extent(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> Float[np.ndarray, "3"]:
    sizes = [side.stop - side.start for side in bounding_box(mask)]
    return np.asarray(np.array(sizes) * grid.spacing)


def _words(values: Float[np.ndarray, "m"]) -> str:
    return " x ".join(f"{value:.3g}" for value in values)
