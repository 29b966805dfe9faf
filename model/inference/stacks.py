"""From a bare array and its affine to a checked `MaskStack`.

The same checks serve requests and training data. A mask holds integers (of any numeric type): zero is
background, 255 marks voxels that were never looked at, every other value is a label.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped

from model.errors import InvalidGeometry, InvalidMask, InvalidParameter
from model.geometry import SHEAR_TOLERANCE, Grid
from model.inference.mask_stack import MaskStack, index_box

#: Value of voxels that were never looked at.
EXCLUDED_VALUE = 255
#: Spacings that a voxel grid of anatomy can have (mm).
SPACING_RANGE_MM = (1e-4, 1e3)
#: Farthest that a grid's origin may lie from the world's (mm).
ORIGIN_LIMIT_MM = 1e6
#: How far a value may be from an integer and still be read as one.
ROUNDING_TOLERANCE = 1e-4
#: More distinct values than this are a picture, not a label map, unless labels are named.
LABEL_LIMIT = 256
#: Labels listed in a message, at most.
LISTED_LABELS = 12
#: An object that is this many times as long as the model's box has its voxels in another unit; shorter by the square
#: of it, too.
UNIT_FACTOR = 10.0


def make_stack(
    part: str,
    values: Shaped[np.ndarray, "..."],
    affine: Float[np.ndarray, "4 4"],
    labels: frozenset[int] | None = None,
) -> MaskStack:
    """Check a mask volume and split it into foreground and excluded voxels.

    Args:
        part: how the caller knows the volume in messages, for example ``mask[0]``.
        values: (i, j, k) label values; trailing axes of length one are dropped.
        affine: from voxel index (voxel centre) to world RAS mm; any orientation, spacing per axis.
        labels: the object's label values; all but 0 and 255 when None.

    Raises:
        InvalidMask: not 3-D, not numbers, soft or negative values, no foreground, label absent.
        InvalidGeometry: see `checked_affine`.
        InvalidParameter: a label that no object can have.
    """
    checked_labels(labels)
    grid_affine = checked_affine(part, affine)
    volume = _volume(part, values)
    present = _present_labels(part, volume)
    _check_presence(part, present, labels)
    integers = volume if volume.dtype.kind in "bui" else np.rint(volume)
    excluded = integers == EXCLUDED_VALUE
    foreground = (integers != 0) & ~excluded if labels is None else np.isin(integers, sorted(labels))
    grid = Grid((volume.shape[0], volume.shape[1], volume.shape[2]), grid_affine)
    absent = frozenset[int]() if labels is None else labels - frozenset(int(label) for label in present)
    return MaskStack(part, grid, foreground, excluded, absent=absent)


def checked_labels(labels: frozenset[int] | None) -> None:
    """Refuse label values that no object can have.

    Raises:
        InvalidParameter: empty, not positive, or 255.
    """
    if labels is None:
        return
    if EXCLUDED_VALUE in labels:
        raise InvalidParameter(
            f"label {EXCLUDED_VALUE} marks voxels that were never looked at; any other positive integer is accepted",
            part="label",
        )
    if not labels or min(labels) < 1:
        raise InvalidParameter("label must name at least one value, and positive integers only", part="label")


def label_warnings(stacks: Sequence[MaskStack]) -> tuple[str, ...]:
    """What to tell of labels of the object that none of its stacks holds, though they hold others."""
    absent = frozenset[int].intersection(*(stack.absent for stack in stacks)) if stacks else frozenset[int]()
    if not absent:
        return ()
    name = stacks[0].part if len(stacks) == 1 else "No mask"
    verb = "does not hold" if len(stacks) == 1 else "holds"
    return (f"{name} {verb} label {_listed(sorted(absent))}; the object is what carries the other labels.",)


def require_length(stacks: Sequence[MaskStack], longest_mm: float) -> None:
    """Refuse an object so long, or so short, that its voxels cannot be in mm.

    Args:
        longest_mm: that an object can be, the longest side of the model's box.

    Raises:
        InvalidMask: over `UNIT_FACTOR` times as long along an axis of its grid, or on no stack the square of that
            part as long.
    """
    lengths_mm = [_length_mm(stack) for stack in stacks]
    if max(lengths_mm) * UNIT_FACTOR**2 < longest_mm:
        raise InvalidMask(
            f"{stacks[0].part} holds an object {max(lengths_mm):.2g} mm long, and the model's are up to "
            f"{longest_mm:.0f} mm; a mask of one of them, whose voxel spacing is in mm, is accepted",
            part=stacks[0].part,
        )
    for stack, length_mm in zip(stacks, lengths_mm, strict=True):
        if length_mm > UNIT_FACTOR * longest_mm:
            raise InvalidMask(
                f"{stack.part} holds an object {length_mm:.0f} mm long, and the model's are at most "
                f"{longest_mm:.0f} mm; a mask of one of them, whose voxel spacing is in mm, is accepted",
                part=stack.part,
            )


def _length_mm(stack: MaskStack) -> float:
    low, high = index_box(stack.foreground)
    return float(((high - low + 1) * stack.grid.spacing).max())


def checked_affine(part: str, affine: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The affine in double precision, if a voxel grid can have it.

    Raises:
        InvalidGeometry: non-finite, spacing outside `SPACING_RANGE_MM`, axes not perpendicular to within
            `SHEAR_TOLERANCE`, or an origin beyond `ORIGIN_LIMIT_MM`.
    """
    matrix = np.array(affine, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InvalidGeometry(
            f"{part} has a non-finite affine; a 4 x 4 matrix of finite numbers is accepted", part=part
        )
    with np.errstate(over="ignore"):
        spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    low, high = SPACING_RANGE_MM
    if not ((spacing >= low) & (spacing <= high)).all():
        raise InvalidGeometry(
            f"{part} has a voxel spacing of zero or out of range; {low:g} to {high:g} mm along each axis is accepted",
            part=part,
        )
    if not _is_unsheared(matrix[:3, :3] / spacing):
        raise InvalidGeometry(f"{part} has a sheared affine; a grid with perpendicular axes is accepted", part=part)
    if np.abs(matrix[:3, 3]).max() > ORIGIN_LIMIT_MM:
        raise InvalidGeometry(
            f"{part} lies over {ORIGIN_LIMIT_MM:g} mm from the world's origin; less is accepted", part=part
        )
    matrix[3] = (0.0, 0.0, 0.0, 1.0)
    return matrix


def _is_unsheared(directions: Float[np.ndarray, "3 3"]) -> bool:
    cosines = directions.T @ directions - np.eye(3)
    return bool(np.abs(cosines).max() <= SHEAR_TOLERANCE)


def _volume(part: str, values: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "i j k"]:
    volume = np.asarray(values)
    while volume.ndim > 3 and volume.shape[-1] == 1:
        volume = volume[..., 0]
    if volume.ndim != 3:
        raise InvalidMask(f"{part} has {volume.ndim} dimensions; a 3-D mask is accepted", part=part)
    if volume.dtype.kind not in "buif":
        raise InvalidMask(f"{part} holds no plain numbers; integer labels are accepted", part=part)
    return volume


def _present_labels(part: str, volume: Shaped[np.ndarray, "i j k"]) -> Shaped[np.ndarray, "l"]:
    """Distinct non-zero values, ascending, 255 among them; a picture may have as many as it has voxels."""
    distinct = _distinct(volume[volume != 0])
    if volume.dtype.kind == "f":
        if not np.isfinite(distinct).all():
            raise InvalidMask(f"{part} holds non-finite values; 0 and integer labels are accepted", part=part)
        if np.abs(distinct - np.rint(distinct)).max(initial=0.0) > ROUNDING_TOLERANCE:
            raise InvalidMask(f"{part} holds soft (fractional) values; 0 and integer labels are accepted", part=part)
        distinct = _distinct(np.rint(distinct))
    if distinct.size and distinct[0] < 0:
        raise InvalidMask(f"{part} holds negative values; 0 and positive integer labels are accepted", part=part)
    return np.asarray(distinct[distinct != 0])


def _distinct(values: Shaped[np.ndarray, "n"]) -> Shaped[np.ndarray, "l"]:
    """Sorted in place, each once; `numpy.unique` takes minutes where nearly all differ."""
    values.sort()
    return values[np.concatenate(([True], values[1:] != values[:-1]))[: len(values)]]


def _check_presence(part: str, present: Shaped[np.ndarray, "l"], labels: frozenset[int] | None) -> None:
    objects = present[present != EXCLUDED_VALUE]
    if not objects.size and present.size:
        raise InvalidMask(
            f"{part} holds no foreground: {EXCLUDED_VALUE} marks voxels that were never looked at; "
            "an object marked with another positive integer is accepted",
            part=part,
        )
    if not objects.size:
        raise InvalidMask(f"{part} holds no foreground; a mask with at least one non-zero label is accepted", part=part)
    if labels is None and len(objects) > LABEL_LIMIT:
        raise InvalidMask(
            f"{part} holds {len(objects)} distinct values, like a picture; a label map or a named label is accepted",
            part=part,
        )
    if labels is not None and not np.isin(objects, sorted(labels)).any():
        wanted = _listed(sorted(labels))
        raise InvalidMask(f"{part} does not hold label {wanted}; labels that are there: {_listed(objects)}", part=part)


def _listed(labels: Sequence[int] | Shaped[np.ndarray, "l"]) -> str:
    rest = len(labels) - LISTED_LABELS
    return ", ".join(str(int(label)) for label in labels[:LISTED_LABELS]) + (f" and {rest} more" if rest > 0 else "")
