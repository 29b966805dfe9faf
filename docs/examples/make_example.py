"""Makes the example mask: a shape drawn from a shipped model, of which three orthogonal slices are kept.

Nobody's anatomy: the shape comes from the model's prior, turned and moved as a scanner might see it.

    python docs/examples/make_example.py model/bundles/hippocampus docs/examples/hippocampus_three_slices.nii.gz
"""

from pathlib import Path

import nibabel as nib
import numpy as np
import typer
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from model.bundle import open_bundle
from model.geometry import Grid
from model.inference.mesh import Mesh, extents, transformed
from model.inference.rasterise import rasterise
from model.inference.sampling import draw_shape

POSITION_MM = (-26.0, -18.0, -12.0)
TURN_DEGREES = (6.0, -4.0, 10.0)
MARGIN_MM = 6.0


def placement() -> Float[np.ndarray, "4 4"]:
    """From the model's canonical frame to the example's world (both RAS mm)."""
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("xyz", TURN_DEGREES, degrees=True).as_matrix()
    affine[:3, 3] = POSITION_MM
    return affine


def grid_around(mesh: Mesh, spacing_mm: float) -> Grid:
    """Axis-aligned RAS grid that holds the mesh with a margin."""
    low, high = extents(mesh)
    size = np.ceil((high - low + 2.0 * MARGIN_MM) / spacing_mm).astype(int)
    affine = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    affine[:3, 3] = np.floor(low - MARGIN_MM)
    return Grid((int(size[0]), int(size[1]), int(size[2])), affine)


def largest_slices(inside: Bool[np.ndarray, "i j k"]) -> Bool[np.ndarray, "i j k"]:
    """Only the voxels of the largest section across each axis."""
    kept = np.zeros_like(inside)
    for axis in range(3):
        others = tuple(other for other in range(3) if other != axis)
        number = int(np.argmax(inside.sum(axis=others)))
        plane = tuple(number if other == axis else slice(None) for other in range(3))
        kept[plane] = inside[plane]
    return kept


def main(bundle: Path, target: Path, seed: int = 7, spacing_mm: float = 1.0) -> None:
    """Draw a shape from BUNDLE and write three of its slices to TARGET (NIfTI)."""
    shape = draw_shape(open_bundle(bundle), seed)
    mesh = transformed(shape.mesh, placement())
    grid = grid_around(mesh, spacing_mm)
    mask = largest_slices(rasterise(mesh, grid)).astype(np.uint8)
    image = nib.Nifti1Image(mask, grid.affine)
    image.header.set_xyzt_units("mm")
    nib.save(image, target)
    typer.echo(f"{int(mask.sum())} annotated voxels of {mask.size} in three slices")


if __name__ == "__main__":
    typer.run(main)
