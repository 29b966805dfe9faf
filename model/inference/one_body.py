"""One connected body: what of a drawing, and of a probability map, does not belong to the reconstructed surface.

The surface is the largest connected component of the field's zero level. Where a drawing shows two objects (left and
right, say), the field that follows its contours has a second component. Maps leave it out, as the surface does, and the
answer says so.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import cKDTree

from model.bundle import ShapeModel
from model.geometry import Grid
from model.inference.mesh import Mesh
from model.inference.observations import Observations
from model.inference.uncertainty import ShapeState, occupancy
from model.inference.voxels import inside_mask

#: A voxel belongs to the object from this probability on.
OCCUPIED = 0.5
#: Drawn points outside the surface are apart from it when they are farther away than this (mm).
APART_MM = 3.0
#: The largest share of what was drawn that may lie apart without a warning.
APART_SHARE = 0.1


def body_probability(model: ShapeModel, state: ShapeState, mesh: Mesh, grid: Grid) -> Float[np.ndarray, "i j k"]:
    """Posterior mean occupancy probability at the voxel centres of a grid, of the surface's body alone.

    Args:
        mesh: the surface of the same state (world mm).
    """
    return of_one_body(occupancy(model, state, grid), grid, mesh)


def body_mask(model: ShapeModel, state: ShapeState, mesh: Mesh, grid: Grid) -> Bool[np.ndarray, "i j k"]:
    """The voxels of a grid that more likely than not belong to the surface's body."""
    if state.members:
        return body_probability(model, state, mesh, grid) >= OCCUPIED
    # However wide it is, the posterior of a fit leaves the more probable label to the fit's own field.
    inside = inside_mask(model, state.fits[0], grid)
    bodies, others = _bodies(inside, grid, mesh)
    return inside & ~np.isin(bodies, others) if len(others) else inside


def of_one_body(probability: Float[np.ndarray, "i j k"], grid: Grid, mesh: Mesh) -> Float[np.ndarray, "i j k"]:
    """An occupancy probability without the bodies that the surface does not enclose.

    Args:
        probability: of each voxel of the grid.
        mesh: the surface (world mm).
    """
    bodies, others = _bodies(probability >= OCCUPIED, grid, mesh)
    if not len(others):
        return probability
    nearest = np.asarray(distance_transform_edt(bodies == 0, grid.spacing, return_distances=False, return_indices=True))
    return np.where(np.isin(bodies[tuple(nearest)], others), np.zeros_like(probability), probability)


def separate_warnings(observations: Observations, logits: Float[np.ndarray, "n"], mesh: Mesh) -> tuple[str, ...]:
    """What to tell about a drawing of which a large part is another body than the surface.

    Args:
        logits: of the fitted field at the observations.
    """
    drawn = observations.labels > 0
    apart = drawn & (logits > 0)
    apart[apart] = _outside_mm(observations.points[apart], mesh) > APART_MM
    share = float(observations.weights[apart].sum() / max(observations.weights[drawn].sum(), 1e-9))
    if share <= APART_SHARE:
        return ()
    sentence = (
        f"{share:.0%} of what was drawn lies apart from the surface, which is one connected object; where the drawing "
        "shows several, send each by itself (label chooses it)."
    )
    return (sentence,)


def _bodies(
    inside: Bool[np.ndarray, "i j k"], grid: Grid, mesh: Mesh
) -> tuple[Int[np.ndarray, "i j k"], Sequence[int]]:
    """The number of each voxel's body, 0 outside all, and the numbers of those that the surface does not enclose."""
    bodies, count = label(inside, np.ones((3, 3, 3), int))
    return bodies, _beyond(bodies, count, grid, mesh) if count > 1 else ()


def _outside_mm(points: Float[np.ndarray, "n 3"], mesh: Mesh) -> Float[np.ndarray, "n"]:
    """Distance of points from the nearest vertex (mm), negative inside the surface."""
    distance, vertex = cKDTree(mesh.vertices).query(points)
    outwards = np.einsum("nd,nd->n", points - mesh.vertices[vertex], mesh.normals[vertex])
    return np.asarray(np.copysign(distance, outwards))


def _beyond(bodies: Int[np.ndarray, "i j k"], count: int, grid: Grid, mesh: Mesh) -> Sequence[int]:
    """Numbers of the bodies that have no voxel inside the surface or next to it."""
    tree = cKDTree(mesh.vertices)
    apart = np.asarray(tree.query(mesh.vertices, k=2)[0])[:, 1]
    reach = float(np.linalg.norm(grid.spacing) + np.median(apart))
    touched = np.zeros(count + 1, bool)
    touched[0] = True
    index = np.argwhere(bodies)
    numbers = bodies[tuple(index.T)]
    near = _outside_mm(grid.to_world(index.astype(float)), mesh) <= reach
    touched[numbers[near]] = True
    return [int(number) for number in np.flatnonzero(~touched)]
