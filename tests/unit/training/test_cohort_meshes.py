"""Cohorts of closed meshes."""

import numpy as np
import pytest
import trimesh
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

from model.errors import CohortError
from tests.cohort_parts import opened
from training.cohorts import CohortOptions
from training.cohorts.meshes import voxelised
from training.cohorts.voxelising import SpaceName, Voxelising


class TestMeshes:
    def ellipsoid(self, n, at=(3.0, -20.0, 7.0)):
        mesh = trimesh.creation.icosphere(subdivisions=4)
        mesh.apply_scale([6.0 + 0.2 * n, 9.0, 12.0])
        mesh.apply_translation(at)
        return mesh

    @pytest.fixture
    def folder(self, tmp_path):
        for n, suffix in enumerate(("stl", "ply", "obj", "stl")):
            self.ellipsoid(n).export(tmp_path / f"e{n}.{suffix}")
        self.write_vtk(tmp_path / "e4.vtk", self.ellipsoid(4))
        return tmp_path

    def write_vtk(self, path, mesh):
        points = "\n".join(" ".join(map(str, point)) for point in mesh.vertices)
        faces = "\n".join("3 " + " ".join(map(str, face)) for face in mesh.faces)
        head = "# vtk DataFile Version 3.0\nmade here\nASCII\nDATASET POLYDATA\n"
        counts = f"POLYGONS {len(mesh.faces)} {4 * len(mesh.faces)}\n"
        path.write_text(f"{head}POINTS {len(mesh.vertices)} float\n{points}\n{counts}{faces}\n")

    def test_every_format_becomes_a_mask_of_the_same_volume_at_its_place(self, folder):
        found = opened(meshes=folder, spacing_mm=0.5)
        assert [case.name for case in found.train] == ["e0", "e1", "e2", "e3", "e4"]
        for n, case in enumerate(found.train):
            world = case.grid.to_world(np.argwhere(case.mask).astype(float))
            assert len(world) * 0.5**3 == pytest.approx(self.ellipsoid(n).volume, rel=0.01)
            assert world.mean(axis=0) == pytest.approx([3.0, -20.0, 7.0], abs=0.03)
            assert np.ptp(world[:, 2]) == pytest.approx(24.0, abs=1.0)

    def test_lps_meshes_are_turned(self, folder):
        case = opened(meshes=folder, space=SpaceName.LPS).train[0]
        world = case.grid.to_world(np.argwhere(case.mask).astype(float))
        assert world.mean(axis=0) == pytest.approx([-3.0, 20.0, 7.0], abs=0.1)

    def test_points_that_are_not_finite_are_refused_by_name(self, folder):
        mesh = self.ellipsoid(0)
        lines = [f"v {' '.join(map(str, point))}" for point in mesh.vertices]
        lines[7] = "v nan 0 0"
        faces = [f"f {' '.join(str(number + 1) for number in face)}" for face in mesh.faces]
        (folder / "nan.obj").write_text("\n".join([*lines, *faces]))
        with pytest.raises(CohortError, match="nan: the mesh has points that are not finite"):
            opened(meshes=folder)

    @pytest.mark.parametrize(
        ("scale", "at", "share"),
        [(0.5, (3.0, -20.0, 7.0), -0.125), (0.5, (40.0, -20.0, 7.0), 0.125), (1.0, (8.0, -20.0, 7.0), None)],
        ids=["a cavity", "a part beside it", "parts that overlap"],
    )
    def test_closed_parts_are_put_together_where_it_is_said_how(self, tmp_path, scale, at, share):
        for n in range(2):
            self.ellipsoid(n).export(tmp_path / f"e{n}.stl")
        whole = self.ellipsoid(2)
        part = self.ellipsoid(2, at=(0.0, 0.0, 0.0))
        part.apply_scale(scale)
        part.apply_translation(at)
        trimesh.util.concatenate([whole, part]).export(tmp_path / "two.stl")
        if share is None:
            with pytest.raises(CohortError, match="two: the mesh has closed parts that overlap"):
                opened(meshes=tmp_path)
            return
        options = CohortOptions(validation_fraction=0.0, skip_refused=True)
        found = {case.name: case for case in opened(options, meshes=tmp_path, spacing_mm=0.5).train}
        assert found["two"].mask.sum() * 0.5**3 == pytest.approx((1.0 + share) * whole.volume, rel=0.01)

    def test_meshes_of_other_formats_are_told(self, folder):
        self.ellipsoid(5).export(folder / "e5.off")
        (told,) = opened(meshes=folder).refused
        assert (told.name, told.stops) == ("e5.off", False)

    def test_an_open_mesh_is_refused_by_name(self, folder):
        mesh = self.ellipsoid(0)
        mesh.update_faces(np.arange(len(mesh.faces)) > 5)
        mesh.export(folder / "open.stl")
        with pytest.raises(CohortError, match=r"open: .*not watertight: .* edge"):
            opened(meshes=folder)
        assert len(opened(CohortOptions(skip_refused=True, validation_fraction=0.0), meshes=folder).train) == 5

    def test_a_damaged_file_and_metres_are_refused_by_name(self, folder):
        (folder / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\n")
        small = self.ellipsoid(0, at=(0, 0, 0))
        small.apply_scale(0.001)
        small.export(folder / "metres.stl")
        with pytest.raises(CohortError) as caught:
            opened(meshes=folder)
        assert "broken: " in str(caught.value)
        assert "metres: " in str(caught.value)
        assert "coordinates in mm" in str(caught.value)

    def test_a_box_has_the_voxels_of_its_volume(self, tmp_path):
        for n in range(3):
            trimesh.creation.box([10.0, 12.0, 8.0 + 2 * n]).export(tmp_path / f"box{n}.stl")
        found = opened(meshes=tmp_path)
        assert [int(case.mask.sum()) for case in found.train] == [10 * 12 * (8 + 2 * n) for n in range(3)]


class TestMeshOfVoxels:
    """A surface made by marching cubes has its faces half-way between the voxels that it was made of."""

    @pytest.fixture
    def mask(self):
        index = np.stack(np.meshgrid(*[np.arange(28)] * 3, indexing="ij"), axis=-1)
        bump = ((index - [20.0, 18.0, 13.5]) ** 2).sum(axis=-1) <= 16.0
        return bump | ((((index - 13.5) / [10.0, 8.0, 6.0]) ** 2).sum(axis=-1) <= 1.0)

    def surface(self, mask, shift=(0.0, 0.0, 0.0)):
        image, cubes = vtkImageData(), vtkFlyingEdges3D()
        image.SetDimensions(*mask.shape)
        image.SetOrigin(*shift)
        image.GetPointData().SetScalars(numpy_to_vtk(mask.astype(np.float32).ravel(order="F"), deep=True))
        cubes.SetInputData(image)
        cubes.SetValue(0, 0.5)
        cubes.Update()
        return cubes.GetOutput()

    @pytest.mark.parametrize(
        "shift", [(0, 0, 0), (0.5, 0.5, 0.5), (0.001, 0.001, 0.001), (-0.001, -0.001, -0.001), (0.1, 0.37, -0.42)]
    )
    @pytest.mark.parametrize(("spacing_mm", "tolerance_mm"), [(1.0, 0.02), (0.5, 0.12), (0.7, 0.12)])
    def test_volume_and_centroid_are_right_wherever_it_lies(self, mask, shift, spacing_mm, tolerance_mm):
        found = voxelised(self.surface(mask, shift), Voxelising(spacing_mm), "voxels")
        assert found.mask.sum() * spacing_mm**3 == pytest.approx(mask.sum(), rel=0.02)
        centroid = found.grid.to_world(np.argwhere(found.mask).astype(float)).mean(axis=0)
        assert centroid == pytest.approx(np.argwhere(mask).mean(axis=0) + shift, abs=tolerance_mm)
        assert np.array_equal(found.mask, voxelised(self.surface(mask), Voxelising(spacing_mm), "voxels").mask)

    @pytest.mark.parametrize("space", list(SpaceName))
    def test_at_its_own_spacing_it_is_the_mask_again_with_room_around_it(self, mask, space):
        found = voxelised(self.surface(mask), Voxelising(1.0, space), "voxels")
        voxels, before = np.argwhere(found.mask), np.argwhere(mask)
        assert np.array_equal(voxels - voxels.min(axis=0), before - before.min(axis=0))
        assert (voxels.min(axis=0) >= 4).all()
        assert (np.array(found.mask.shape) - 1 - voxels.max(axis=0) >= 4).all()
        sign = -1.0 if space is SpaceName.LPS else 1.0
        assert found.grid.to_world(voxels.astype(float)) == pytest.approx(before * [sign, sign, 1.0], abs=0.01)
