"""Surface of a shape given by latent code and pose."""

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.errors import InvalidParameter, TooLarge
from model.geometry import Grid, Pose
from model.inference.discrepancy.process import Discrepancy
from model.inference.fitting import Fit
from model.inference.isosurface import FieldWithGradient, extract_surface
from model.inference.mesh import Mesh, extents, of_largest_component, subset, transformed
from model.inference.posterior import FieldDerivatives, chunks, field_derivatives

#: Room around the box of all training shapes in which a surface is looked for.
BOX_MARGIN_MM = 6.0
#: Accepted grid steps (mm) of a surface that a caller chooses.
SPACING_RANGE_MM = (0.25, 10.0)


def surface_of(
    model: ShapeModel,
    latent: Float[np.ndarray, "d"],
    pose: Pose,
    step_mm: float | None = None,
    discrepancy: Discrepancy | None = None,
    *,
    keep_specks: bool = False,
) -> Mesh:
    """Watertight surface in world mm, extracted in the canonical frame so that it turns with its input.

    Args:
        latent: (d,) latent code.
        pose: world to canonical.
        step_mm: grid step in world mm; the model's own when None.
        discrepancy: added to the decoder's field.
        keep_specks: keep all components; only the one of largest volume otherwise.
    """

    def piece(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
        logits, by_point = (part[0] for part in model.decoder.logits_and_gradients(latent[None], points[None]))
        if discrepancy is None:
            return logits, by_point
        return discrepancy.corrected_with_gradient(logits, by_point, points)

    def gradient(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
        values, slopes = zip(*map(piece, chunks(points)), strict=True)
        return np.concatenate(values), np.concatenate(slopes)

    return _extracted(model, latent, pose, step_mm, discrepancy, gradient, keep_specks=keep_specks)


def differentiated_surface(
    model: ShapeModel, found: Fit, step_mm: float | None = None
) -> tuple[Mesh, FieldDerivatives | None]:
    """The surface of a fit as `surface_of` has it, and the field's derivatives at its vertices; None without any.

    Vertices and normals need the derivatives by point anyway; those by parameter come with them for little. They are
    taken just before the last step of the vertices, which is far too short to alter them.
    """
    taken: list[FieldDerivatives] = []

    def gradient(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
        taken.append(field_derivatives(model, found, points))
        return taken[-1].logits, taken[-1].by_point

    whole = _extracted(model, found.latent, found.pose, step_mm, found.discrepancy, gradient, keep_specks=True)
    if not taken:
        return whole, None
    keep, removed = of_largest_component(whole)
    return (subset(whole, keep), taken[-1].of(keep)) if removed else (whole, taken[-1])


def _extracted(
    model: ShapeModel,
    latent: Float[np.ndarray, "d"],
    pose: Pose,
    step_mm: float | None,
    discrepancy: Discrepancy | None,
    gradient: FieldWithGradient,
    *,
    keep_specks: bool,
) -> Mesh:
    half = canonical_box(model)
    step = (step_mm or model.manifest.resolution_mm) * float(np.exp(pose.log_scale))

    def piece(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        logits = model.decoder.logits(latent[None], points[None])[0]
        return logits if discrepancy is None else discrepancy.corrected(logits, points)

    def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        return np.concatenate([piece(chunk) for chunk in chunks(points)])

    mesh = extract_surface(field, -half, half, step, gradient=gradient, keep_specks=keep_specks)
    affine = np.eye(4)
    affine[:3, :3] = np.linalg.inv(pose.linear)
    affine[:3, 3] = pose.position
    return transformed(mesh, affine)


def canonical_box(model: ShapeModel) -> Float[np.ndarray, "3"]:
    """Half size of the canonical box that is searched (mm)."""
    return np.asarray(model.manifest.half_extent_mm, float) + BOX_MARGIN_MM


def require_spacing(spacing_mm: float | None, part: str = "spacing_mm") -> None:
    """Refuse a grid step (mm) that a caller must not choose.

    Args:
        part: how the caller knows the step.

    Raises:
        InvalidParameter: outside 0.25 to 10.
    """
    low, high = SPACING_RANGE_MM
    if spacing_mm is not None and not low <= spacing_mm <= high:
        raise InvalidParameter(
            f"{part} is {spacing_mm:g}; a grid step from {low:g} to {high:g} mm is accepted.", part=part
        )


def require_step(
    model: ShapeModel, step_mm: float | None, max_voxels: int, *, part: str = "spacing_mm", log_scale: float = 0.0
) -> None:
    """Refuse a grid step at which the box that is searched has more voxels than allowed.

    Args:
        step_mm: in world mm; the model's own when None.
        part: how the caller knows the step.
        log_scale: of the object's pose; a larger object than the model's needs as many more steps along each axis.

    Raises:
        TooLarge: it has.
    """
    scale = float(np.exp(log_scale))
    step = (model.manifest.resolution_mm if step_mm is None else step_mm) * scale
    if not step > 0 or np.prod(np.ceil(2 * canonical_box(model) / step) + 1) <= max_voxels:
        return
    size = f" for an object {1.0 / scale:.2g} times as large as the model's" if log_scale < 0 else ""
    asked = f"The parameter {part} asks for" if step_mm is not None else "The model's own step makes"
    sentence = f"{asked} more than {max_voxels} voxels{size}; a coarser {part} is accepted."
    raise TooLarge(sentence, part=part)


def covering_grid(mesh: Mesh, spacing_mm: float, margin_mm: float = 5.0) -> Grid:
    """Axis-aligned RAS grid around a mesh."""
    lower, upper = extents(mesh)
    lower, upper = lower - margin_mm, upper + margin_mm
    shape = np.ceil((upper - lower) / spacing_mm).astype(int) + 1
    affine = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    affine[:3, 3] = lower
    return Grid((int(shape[0]), int(shape[1]), int(shape[2])), affine)
