"""What of a reconstruction a dense mask can judge, where its crop cuts the object off.

The model goes on beyond such a face of the crop, as the object itself does. How far, no mask tells, so what lies there
is nobody's error.
"""

import numpy as np
from jaxtyping import Bool, Float

from model.geometry import Grid
from model.inference.mesh import Mesh
from model.inference.rasterise import rasterise
from training.cohorts.cohort import Case
from training.cohorts.inspect import cut_faces


def in_view(case: Case, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which points (world RAS mm) do not lie beyond a face of the crop that cuts the object off."""
    index, cut = case.grid.to_index(points), cut_faces(case.mask)
    beyond = (cut[0] & (index < -0.5)) | (cut[1] & (index > np.array(case.grid.shape) - 0.5))
    return np.asarray(~beyond.any(axis=1))


def volume_out_of_view_ml(case: Case, mesh: Mesh) -> float:
    """Volume (mL) that a closed mesh (world RAS mm) encloses beyond faces of the crop that cut the object off.

    Counted in voxels of the mask's size.
    """
    if in_view(case, mesh.vertices).all():
        return 0.0
    inside = _voxels_of(mesh, case.grid)
    return float((~in_view(case, inside)).sum() * np.prod(case.grid.spacing) / 1000.0)


def _voxels_of(mesh: Mesh, grid: Grid) -> Float[np.ndarray, "n 3"]:
    """Centres (world RAS mm) of the voxels inside a mesh, the grid going on as far as the mesh does."""
    index = grid.to_index(mesh.vertices)
    before = np.maximum(0.0, np.ceil(-index.min(axis=0)))
    behind = np.maximum(0.0, np.ceil(index.max(axis=0)) - (np.array(grid.shape) - 1))
    shape = (np.array(grid.shape) + before + behind).astype(int)
    affine = grid.affine.copy()
    affine[:3, 3] = grid.to_world(-before[None])[0]
    wide = Grid((int(shape[0]), int(shape[1]), int(shape[2])), affine)
    return wide.to_world(np.argwhere(rasterise(mesh, wide)).astype(float))
