"""Generated shapes against the training shapes: the protocol of the MorphoFlow paper.

For each of 1500 shapes drawn from the base Gaussian, none of them between two clusters of codes
(`model.inference.clusters`): its distance in z0 to the nearest training code, and the distance between its surface and
that training shape's, the mean of both directions. Pearson's r of the two and its square are reported.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkFiltersGeneral import vtkDistancePolyDataFilter

from model.bundle import ShapeModel
from model.geometry import Pose
from model.inference.clusters import clusters_of, drawn_base
from model.inference.mesh import Mesh
from model.inference.surface import canonical_box, surface_of

SAMPLES = 1500
#: Grid steps along the longest side of the model's box: the surfaces' resolution.
STEPS = 32

Watch = Callable[[int], None]


@dataclass(frozen=True)
class Generation:
    """What was drawn.

    Attributes:
        latent: (n,) distance in z0 to the nearest training code.
        surface_mm: (n,) mean distance between the surfaces of the draw and of that training code.
    """

    latent: Float[np.ndarray, "n"]
    surface_mm: Float[np.ndarray, "n"]

    @property
    def pearson(self) -> float:
        """Pearson's r; not a number for fewer than three draws or no spread."""
        if len(self.latent) < 3 or np.ptp(self.latent) == 0 or np.ptp(self.surface_mm) == 0:
            return float("nan")
        return float(np.corrcoef(self.latent, self.surface_mm)[0, 1])

    @property
    def r_squared(self) -> float:
        """Share of the variance that a line explains."""
        return self.pearson**2


def generated(
    model: ShapeModel, *, samples: int = SAMPLES, seed: int = 0, watch: Watch = lambda number: None
) -> Generation:
    """Draw from a model and measure; draws without a surface are left out.

    Args:
        samples: how many; none are accepted.
        seed: of the draws.
        watch: called after each with its number.
    """
    if samples == 0:
        return Generation(np.zeros(0), np.zeros(0))
    sigmas, codes = np.asarray(model.manifest.sigmas), model.population.base_codes
    stream, clusters = np.random.default_rng(seed), clusters_of(model.manifest)
    bases = np.stack([drawn_base(sigmas, clusters, stream)[0] for _ in range(samples)])
    latents = model.prior.from_base(bases)
    step = 2.0 * float(canonical_box(model).max()) / STEPS
    known: dict[int, Mesh] = {}
    found: list[tuple[float, float]] = []
    for number, (base, latent) in enumerate(zip(bases, latents, strict=True)):
        gaps = np.linalg.norm(codes - base, axis=1)
        nearest = int(gaps.argmin())
        if nearest not in known:
            known[nearest] = surface_of(model, model.population.codes[nearest], Pose(), step)
        mesh = surface_of(model, latent, Pose(), step)
        if not mesh.is_empty and not known[nearest].is_empty:
            found.append((float(gaps[nearest]), surface_distance(mesh, known[nearest])))
        watch(number)
    values = np.array(found, float).reshape(-1, 2)
    return Generation(values[:, 0], values[:, 1])


def surface_distance(one: Mesh, other: Mesh) -> float:
    """Mean distance (mm) of vertices to the other surface, mean of both directions."""
    distances = vtkDistancePolyDataFilter()
    distances.SetInputData(0, _poly_data(one))
    distances.SetInputData(1, _poly_data(other))
    distances.SignedDistanceOff()
    distances.ComputeCellCenterDistanceOff()
    distances.ComputeSecondDistanceOn()
    distances.Update()
    found = [vtk_to_numpy(distances.GetOutput(port).GetPointData().GetArray("Distance")) for port in (0, 1)]
    return float(np.mean([values.mean() for values in found]))


def _poly_data(mesh: Mesh) -> Any:
    points, cells, data = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(mesh.vertices), deep=True))
    rows = np.column_stack([np.full(len(mesh.faces), 3), mesh.faces]).astype(np.int64).ravel()
    cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(rows, deep=True))
    data.SetPoints(points)
    data.SetPolys(cells)
    return data
