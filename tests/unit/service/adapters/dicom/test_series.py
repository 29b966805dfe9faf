"""Images of a series that a surface comes near."""

from dataclasses import replace

import highdicom as hd
import numpy as np
import pytest
import trimesh
from pydicom.uid import generate_uid

from model.inference.mesh import mesh_of
from model.inference.reconstruction import SURFACE_SD
from service.adapters.dicom.series import MARGIN_MM, MARGIN_SDS, around, series_of
from tests.dicom_parts import mr_series, reread


def surface(series, planes, radius_mm=2.0, sd_mm=None):
    """A ball around the middle of a plane of a series."""
    centre = series.grid.to_world(np.array([[18.0, 15.0, float(planes)]]))[0]
    ball = trimesh.creation.icosphere(2, radius_mm)
    mesh = mesh_of(ball.vertices + centre, ball.faces)
    return mesh if sd_mm is None else replace(mesh, scalars={SURFACE_SD: np.full(len(mesh.vertices), sd_mm)})


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("sd_mm", [None, 0.5])
def test_images_near_the_surface_are_left_with_their_places(backwards, sd_mm):
    images = mr_series(spacing=(1.0, 1.0, 0.5))
    series = series_of(images[::-1] if backwards else images)
    mesh = surface(series, 12, sd_mm=sd_mm)
    found = around(series, mesh)
    reach_mm = 2.0 + MARGIN_MM + MARGIN_SDS * (sd_mm or 0.0)
    heights = np.array([float(image.ImagePositionPatient[2]) for image in series.images])
    near = np.abs(heights - heights[list(series.order).index(12)]) <= reach_mm + 1e-6
    assert [image.SOPInstanceUID for image in found.images] == [
        image.SOPInstanceUID for image, is_near in zip(series.images, near, strict=True) if is_near
    ]
    for image, place in zip(found.images, found.order, strict=True):
        corner = found.grid.to_world(np.array([[0.0, 0.0, float(place)]]))[0]
        assert corner * [-1.0, -1.0, 1.0] == pytest.approx([float(x) for x in image.ImagePositionPatient], abs=1e-4)
    assert found.grid.shape[2] == len(found.images)
    assert found.grid.frame_of_reference == series.grid.frame_of_reference


@pytest.mark.parametrize("plane", [-30, 0, 25, 60])
def test_an_object_at_the_border_or_beyond_has_the_images_next_to_it(plane):
    series = series_of(mr_series())
    found = around(series, surface(series, plane))
    ends = {0} if plane <= 0 else {25}
    assert found.images
    assert ends <= {int(image.InstanceNumber) - 1 for image in found.images}


def test_one_image_of_many_frames_stays_whole():
    images = mr_series()
    for image in images:
        image.WindowCenter, image.WindowWidth = 40, 400
    enhanced = hd.legacy.LegacyConvertedEnhancedMRImage(images, generate_uid(), 5, generate_uid(), 1)
    series = series_of([reread(enhanced)])
    assert around(series, surface(series, 12)) is series
