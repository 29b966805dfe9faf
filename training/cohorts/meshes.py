"""A folder of watertight meshes: STL, PLY, OBJ, legacy VTK and VTP, made masks of by VTK's stencil.

A voxel belongs to the object when its centre lies inside the surface. Centres lie symmetrically about the mesh, so that
a mask does not depend on where its mesh lies, and just off the faces that a mesh made of voxels has. Splits and persons
come from ``cases.csv`` and from folders named train, validation and test, as for masks. Coordinates are mm; files of
LPS programs are turned to RAS.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import VTK_UNSIGNED_CHAR, vtkObject
from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPolyData
from vtkmodules.vtkFiltersCore import (
    vtkCleanPolyData,
    vtkFeatureEdges,
    vtkPolyDataConnectivityFilter,
    vtkTriangleFilter,
)
from vtkmodules.vtkImagingStencil import vtkImageStencil, vtkPolyDataToImageStencil
from vtkmodules.vtkIOGeometry import vtkOBJReader, vtkSTLReader
from vtkmodules.vtkIOLegacy import vtkPolyDataReader
from vtkmodules.vtkIOPLY import vtkPLYReader
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

from model.errors import CohortError, InvalidMask, UnreadableImage
from model.geometry import Grid
from training.cohorts.assemble import CohortOptions, assemble
from training.cohorts.cohort import Cohort, Provenance
from training.cohorts.folder import absent, own_table, read_cases, unread_files
from training.cohorts.inspect import EXTENT_RANGE_MM
from training.cohorts.reading import MaskFile, stem
from training.cohorts.voxelising import SpaceName, Voxelising

READERS: dict[str, Callable[[], Any]] = {
    ".stl": vtkSTLReader,
    ".ply": vtkPLYReader,
    ".obj": vtkOBJReader,
    ".vtk": vtkPolyDataReader,
    ".vtp": vtkXMLPolyDataReader,
}
SUFFIXES = tuple(READERS)
#: Formats of meshes that are not read.
OTHER_MESHES = (".off", ".glb", ".gltf", ".3mf", ".mz3", ".dae", ".x3d", ".wrl", ".vtu", ".gii", ".msh", ".fbx", ".pcd")
OWN_MESHES = Provenance("meshes of the caller", "not stated", "", shippable=False)
ONE_MM = Voxelising()
#: Room of background around a mesh (mm), and the most voxels that one may become.
MARGIN_MM = 4.0
MOST_VOXELS = 100_000_000
#: Centres are so much off their symmetric places along each axis (steps), as no face of a mesh is.
OFF_FACES = np.array([0.0061, 0.0083, 0.0047])
#: A mesh of this share of a voxel more than a whole number of them is as wide as one more.
WIDER = 0.51


def read_meshes(folder: Path, options: CohortOptions, *, how: Voxelising = ONE_MM) -> Cohort:
    """Every mesh below a folder as a cohort of masks.

    Raises:
        CohortError: no folder, a table that cannot be used, or what `assemble` refuses.
    """
    if not folder.is_dir():
        raise CohortError("The folder of meshes does not exist; an existing folder is accepted.")
    rows = own_table(folder)
    found = [path for path in folder.rglob("*") if path.is_file()]
    files = sorted(path for path in found if is_mesh_file(path))
    if not files:
        raise CohortError(f"The folder holds no mesh; {', '.join(SUFFIXES)} are accepted.")
    cases, refused = read_cases(files, folder, rows, read=lambda path: read_mesh(path, how))
    refused += [*absent(rows, map(stem, files)), *unread_files(found, OTHER_MESHES, ", ".join(SUFFIXES))]
    return assemble(folder.resolve().name, cases, refused, OWN_MESHES, options)


def is_mesh_file(path: Path) -> bool:
    """Whether the suffix is one that `read_mesh` takes."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def read_mesh(path: Path, how: Voxelising) -> MaskFile:
    """A mesh file as a mask.

    Raises:
        UnreadableImage: no mesh, or one that ends too early.
        InvalidMask: a surface that is not closed, or one of a size that anatomy in mm has not.
    """
    surface = closed_surface(path)
    return voxelised(surface, how, stem(path))


def closed_surface(path: Path) -> Any:
    """The triangles of a file (``vtkPolyData``), equal points merged.

    Raises:
        UnreadableImage: no mesh, or one that ends too early.
        InvalidMask: edges that do not belong to exactly two triangles.
    """
    reader = READERS[path.suffix.lower()]()
    reader.SetFileName(str(path))
    triangles, clean = vtkTriangleFilter(), vtkCleanPolyData()
    triangles.SetPassLines(False)
    triangles.SetPassVerts(False)
    triangles.SetInputConnection(reader.GetOutputPort())
    clean.SetInputConnection(triangles.GetOutputPort())
    with _quiet():
        clean.Update()
    surface = clean.GetOutput()
    if reader.GetErrorCode() or surface.GetNumberOfPolys() == 0:
        raise UnreadableImage("the file cannot be read; a complete mesh of triangles is accepted", part=stem(path))
    if not np.isfinite(vtk_to_numpy(surface.GetPoints().GetData())).all():
        raise InvalidMask("the mesh has points that are not finite; finite coordinates are accepted", part=stem(path))
    edges = _bad_edges(surface)
    if edges:
        raise InvalidMask(
            f"the mesh is not watertight: {edges} edge(s) do not belong to exactly two triangles; "
            "a closed surface is accepted",
            part=stem(path),
        )
    return surface


def voxelised(surface: Any, how: Voxelising, name: str) -> MaskFile:
    """Voxels whose centres lie inside a closed surface.

    Args:
        name: of the mesh, for errors.

    Raises:
        InvalidMask: an extent that anatomy in mm has not, or more than `MOST_VOXELS`.
    """
    bounds = np.reshape(surface.GetBounds(), (3, 2))
    extent = float(np.ptp(bounds, axis=1).max())
    low, high = EXTENT_RANGE_MM
    if not low <= extent <= high:
        raise InvalidMask(
            f"the mesh is {extent:.3g} mm long; coordinates in mm, {low:g} to {high:g} long, are accepted", part=name
        )
    lower, shape = _lattice(bounds, how.spacing_mm)
    if shape.astype(float).prod() > MOST_VOXELS:
        raise InvalidMask(f"the mesh would have over {MOST_VOXELS} voxels; a larger spacing is accepted", part=name)
    mask = _filled(surface, lower, shape, how.spacing_mm, name)
    affine = np.diag([how.spacing_mm] * 3 + [1.0])
    affine[:3, 3] = lower
    if how.space is SpaceName.LPS:
        affine = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    return MaskFile(mask, Grid((int(shape[0]), int(shape[1]), int(shape[2])), affine))


def _filled(
    surface: Any, lower: Float[np.ndarray, "3"], shape: Int[np.ndarray, "3"], spacing_mm: float, name: str
) -> Bool[np.ndarray, "i j k"]:
    """What the closed parts of a surface enclose: those inside others are cavities, or lie in these.

    Raises:
        InvalidMask: parts that overlap, of which it is not said what they enclose together.
    """
    inside = np.zeros(tuple(shape), bool)
    for part in _parts(surface):
        reach = (np.reshape(part.GetBounds(), (3, 2)).T - lower) / spacing_mm
        first, stop = (
            np.maximum(np.floor(reach[0]).astype(int), 0),
            np.minimum(np.ceil(reach[1]).astype(int) + 1, shape),
        )
        around = inside[tuple(slice(a, b) for a, b in zip(first, stop, strict=True))]
        own = _stencil(part, lower + first * spacing_mm, stop - first, spacing_mm)
        common = own & around
        if common.any() and not np.array_equal(common, own):
            raise InvalidMask(
                "the mesh has closed parts that overlap; parts inside or beside each other are accepted", part=name
            )
        around ^= own
    return inside


def _parts(surface: Any) -> list[Any]:
    """The connected parts of a surface, by their extent, largest first."""
    every = vtkPolyDataConnectivityFilter()
    every.SetInputData(surface)
    every.SetExtractionModeToAllRegions()
    every.ColorRegionsOn()
    every.Update()
    if every.GetNumberOfExtractedRegions() == 1:
        return [surface]
    one, clean, parts = vtkPolyDataConnectivityFilter(), vtkCleanPolyData(), []
    one.SetInputData(surface)
    one.SetExtractionModeToSpecifiedRegions()
    clean.SetInputConnection(one.GetOutputPort())
    for number in range(every.GetNumberOfExtractedRegions()):
        one.InitializeSpecifiedRegionList()
        one.AddSpecifiedRegion(number)
        clean.Update()
        part = vtkPolyData()
        part.DeepCopy(clean.GetOutput())
        parts.append(part)
    return sorted(parts, key=lambda part: -float(part.GetLength()))


def _lattice(bounds: Float[np.ndarray, "3 2"], step_mm: float) -> tuple[Float[np.ndarray, "3"], Int[np.ndarray, "3"]]:
    """First centre (mm) and number of voxels along each axis, with room on both sides of a mesh of these bounds.

    The outermost faces of the mesh lie a quarter of a step from the nearest centres at least, and half a step from
    them where the mesh is a whole number of steps wide, as meshes made of voxels are.
    """
    across = np.ceil(np.ptp(bounds, axis=1) / step_mm - WIDER)
    shape = (across + 2.0 * np.ceil(MARGIN_MM / step_mm)).astype(int)
    return bounds.mean(axis=1) + (OFF_FACES - (shape - 1) / 2.0) * step_mm, shape


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep VTK's own words on a bad file from the caller."""
    shown = vtkObject.GetGlobalWarningDisplay()
    vtkObject.SetGlobalWarningDisplay(0)
    try:
        yield
    finally:
        vtkObject.SetGlobalWarningDisplay(shown)


def _stencil(
    surface: Any, lower: Float[np.ndarray, "3"], shape: Int[np.ndarray, "3"], spacing_mm: float
) -> Bool[np.ndarray, "i j k"]:
    image = vtkImageData()
    image.SetOrigin(*lower.tolist())
    image.SetSpacing(spacing_mm, spacing_mm, spacing_mm)
    image.SetDimensions(*shape.tolist())
    image.AllocateScalars(VTK_UNSIGNED_CHAR, 1)
    vtk_to_numpy(image.GetPointData().GetScalars())[:] = 1
    inside, cut = vtkPolyDataToImageStencil(), vtkImageStencil()
    inside.SetInputData(surface)
    inside.SetOutputOrigin(*lower.tolist())
    inside.SetOutputSpacing(spacing_mm, spacing_mm, spacing_mm)
    inside.SetOutputWholeExtent(image.GetExtent())
    inside.SetTolerance(0.0)
    cut.SetInputData(image)
    cut.SetStencilConnection(inside.GetOutputPort())
    cut.SetBackgroundValue(0)
    cut.Update()
    values = vtk_to_numpy(cut.GetOutput().GetPointData().GetScalars())
    return np.asarray(values.reshape(shape, order="F") != 0)


def _bad_edges(surface: Any) -> int:
    edges = vtkFeatureEdges()
    edges.SetInputData(surface)
    edges.BoundaryEdgesOn()
    edges.NonManifoldEdgesOn()
    edges.FeatureEdgesOff()
    edges.ManifoldEdgesOff()
    edges.Update()
    return int(edges.GetOutput().GetNumberOfCells())
