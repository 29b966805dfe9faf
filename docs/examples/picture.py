"""A picture of a reconstruction: what was drawn, the surface coloured by its uncertainty, and the entropy map."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import nibabel as nib
import numpy as np
import trimesh
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

LIGHT = np.array([-0.4, -0.6, 0.7]) / np.linalg.norm([-0.4, -0.6, 0.7])
AMBIENT = 0.45
VIEW = {"elev": 28.0, "azim": -35.0}
ZOOM = 1.2


def draw(mask: Path, mesh: Path, surface_sd: Sequence[float], entropy: Path, target: Path) -> None:
    """Write the picture (PNG).

    Args:
        mask: the sparse segmentation that was sent (NIfTI).
        mesh: its surface (PLY, RAS mm).
        surface_sd: standard deviation of the surface at each of the mesh's vertices (mm).
        entropy: voxel entropy (NIfTI, nats).
        target: where the picture goes.
    """
    surface = trimesh.load_mesh(mesh, process=False)
    drawn = annotated_points(mask)
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=(13.0, 4.4), layout="constrained")
        left = figure.add_subplot(1, 3, 1, projection="3d")
        middle = figure.add_subplot(1, 3, 2, projection="3d")
        right = figure.add_subplot(1, 3, 3)
        draw_slices(left, drawn)
        colours = draw_surface(middle, surface, np.asarray(surface_sd))
        figure.colorbar(colours, ax=middle, shrink=0.7, label="SD of the surface (mm)")
        figure.colorbar(draw_entropy(right, entropy), ax=right, shrink=0.7, label="entropy (nats)")
        for axes in (left, middle):
            frame(axes, np.asarray(surface.vertices))
        figure.savefig(target, dpi=130)


def annotated_points(mask: Path) -> Float[np.ndarray, "n 3"]:
    """Centres of the foreground voxels, RAS mm."""
    image = nib.Nifti1Image.from_filename(mask)
    index = np.argwhere(np.asarray(image.dataobj) > 0)
    return np.asarray(nib.affines.apply_affine(image.affine, index))


def draw_slices(axes: Axes3D, points: Float[np.ndarray, "n 3"]) -> None:
    """What was drawn."""
    axes.scatter(points[:, 0], points[:, 1], points[:, 2], s=9, c="#1f5f8b", marker="s", linewidths=0, depthshade=False)
    axes.set_title("three annotated slices")


def draw_surface(axes: Axes3D, surface: trimesh.Trimesh, sd: Float[np.ndarray, "v"]) -> ScalarMappable:
    """The surface, lit from above and coloured by its standard deviation."""
    faces = np.asarray(surface.faces)
    scale = ScalarMappable(Normalize(0.0, float(np.percentile(sd, 99))), colormaps["viridis"])
    colours = scale.to_rgba(sd[faces].mean(axis=1))
    shade = AMBIENT + (1.0 - AMBIENT) * np.clip(np.asarray(surface.face_normals) @ LIGHT, 0.0, 1.0)
    colours[:, :3] *= shade[:, None]
    axes.add_collection3d(Poly3DCollection(np.asarray(surface.vertices)[faces], facecolors=colours, linewidths=0))
    axes.set_title("reconstruction")
    return scale


def draw_entropy(axes: Axes, entropy: Path) -> ScalarMappable:
    """The slice of the map that holds most entropy, first two world axes as near as the grid has them."""
    image = nib.as_closest_canonical(nib.Nifti1Image.from_filename(entropy))
    values = np.asarray(image.dataobj, dtype=float)
    number = int(np.argmax(values.sum(axis=(0, 1))))
    width, height = image.header.get_zooms()[:2]
    shown = axes.imshow(
        values[:, :, number].T, origin="lower", cmap="magma", vmin=0.0, vmax=float(np.log(2.0)), aspect=height / width
    )
    axes.set(title="uncertainty, axial section", xticks=[], yticks=[])
    return shown


def frame(axes: Axes3D, vertices: Float[np.ndarray, "v 3"]) -> None:
    """Equal scale, the same box and the same view for every panel."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(tuple(high - low), zoom=ZOOM)
    axes.locator_params(nbins=4)
    axes.view_init(**VIEW)
    axes.set(xlabel="R (mm)", ylabel="A (mm)", zlabel="S (mm)")
