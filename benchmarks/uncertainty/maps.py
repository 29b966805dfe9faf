"""Posterior SD beside the true error, on the surface: what the user is shown, and what it should have said."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from scipy.stats import spearmanr

from benchmarks.accuracy.drawings import DrawingName, draw
from benchmarks.accuracy.pictures import CONTOUR_COLOUR, contours
from model.bundle import ShapeModel
from model.inference.mesh import Mesh
from model.inference.reconstruction import SURFACE_SD, Options, reconstruct
from training.cohorts.cohort import Case
from training.field_of_view import in_view
from training.rendering import STEPS, Surface, axes_around, show
from training.surface_error import distances_to, true_points

COLOURS = colormaps["viridis"]
#: Colours end at this quantile of the SDs and errors of a case.
HIGHEST = 0.98
#: Colour of what the truth does not show.
UNSEEN = (0.8, 0.8, 0.8)


def save_maps(model: ShapeModel, cases: Sequence[Case], drawing: DrawingName, path: Path) -> None:
    """One row a case: SD with the drawn contours, and the distance to the truth, in the same colours.

    Faces that the truth cannot judge are grey there, and colours and correlation are those of the others.
    """
    figure = Figure(figsize=(7.0, 3.1 * len(cases)), layout="constrained")
    step = max(1.0, 2.0 * max(model.manifest.half_extent_mm) / STEPS)
    for row, case in enumerate(cases):
        drawn = draw(case, drawing)
        mesh = reconstruct(model, drawn.stacks, Options(annotated=drawn.planes, resolution_mm=step)).mesh
        sd, error = mesh.scalars[SURFACE_SD], distances_to(true_points(case.mask, case.grid), mesh.vertices)
        seen = in_view(case, mesh.vertices)
        scale = Normalize(0.0, float(np.quantile(np.concatenate([sd[seen], error[seen]]), HIGHEST)))
        left, right = (axes_around(figure, (len(cases), 2, 2 * row + k), mesh.vertices) for k in (1, 2))
        show(left, _surface(mesh), _colours(mesh, sd, scale))
        left.add_collection3d(Line3DCollection(contours(drawn), colors=CONTOUR_COLOUR, linewidths=1.2))
        left.set_title(f"{case.name}: SD of the surface", fontsize=9)
        unseen = ~seen[mesh.faces].all(axis=1)
        show(right, _surface(mesh), np.where(unseen[:, None], UNSEEN, _colours(mesh, error, scale)))
        rank = spearmanr(sd[seen], error[seen]).statistic
        right.set_title(f"distance to the truth, rank correlation {rank:.2f}", fontsize=9)
        figure.colorbar(ScalarMappable(scale, COLOURS), ax=right, shrink=0.7).set_label("mm", fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)


def _surface(mesh: Mesh) -> Surface:
    return Surface(mesh.vertices, np.asarray(mesh.faces, np.int64))


def _colours(mesh: Mesh, values: Float[np.ndarray, "v"], scale: Normalize) -> Float[np.ndarray, "f 3"]:
    return np.asarray(COLOURS(scale(values[mesh.faces].mean(axis=1)))[:, :3])
