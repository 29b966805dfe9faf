"""The surface of a code and a pose, against the ellipsoid that they stand for."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.geometry import Pose
from model.inference.mesh import area_cm2, extents, is_watertight, volume_ml
from model.inference.posterior import CHUNK, fitted_jacobians
from model.inference.surface import BOX_MARGIN_MM, canonical_box, covering_grid, differentiated_surface, surface_of
from model.interruption import interruptible
from tests import few_planes
from tests.analytic_model import STEEPNESS, EllipsoidDecoder, bent_model, ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import rotation

MODEL = ellipsoid_model()
POSE = Pose(np.array([50.0, -30.0, 7.0]), rotation(35.0, (1.0, 2.0, 3.0)), 0.1, mirrored=True)
LATENT = np.array([0.5, -0.8, 1.0])


class SpeckDecoder(EllipsoidDecoder):
    """The ellipsoid, and a ball of 2 mm away from it."""

    def logits_and_jacobians(self, latent, points):
        logits, by_latent, by_point = super().logits_and_jacobians(latent, points)
        offset = points - np.array([0.0, 0.0, 16.0])
        radius = np.linalg.norm(offset, axis=-1, keepdims=True)
        ball = STEEPNESS * (1.0 - radius[..., 0] / 2.0)
        other = (ball > logits)[..., None]
        slopes = np.where(other, -STEEPNESS / 2.0 * offset / radius, by_point)
        return np.maximum(logits, ball), np.where(other, 0.0, by_latent), slopes

    def logits(self, latent, points):
        return self.logits_and_jacobians(latent, points)[0]


def ellipsoid_of(latent, pose):
    axes = MODEL.decoder.axes(latent[None])[0] * np.exp(-pose.log_scale)
    turn = np.linalg.inv(pose.linear) * np.exp(pose.log_scale)
    return Ellipsoid(tuple(axes), pose.position, turn)


@settings(max_examples=15)
@given(
    latent=st.tuples(*[st.floats(-2.0, 2.0)] * 3).map(np.array),
    step=st.tuples(*[st.floats(-50.0, 50.0)] * 3, *[st.floats(-2.0, 2.0)] * 3, st.floats(-0.3, 0.3)).map(np.array),
    mirrored=st.booleans(),
)
def test_mesh_is_that_of_the_posed_ellipsoid(latent, step, mirrored):
    pose = Pose(mirrored=mirrored).moved(step)
    mesh, ellipsoid = surface_of(MODEL, latent, pose), ellipsoid_of(latent, pose)
    assert is_watertight(mesh)
    assert volume_ml(mesh) == pytest.approx(ellipsoid.volume_ml, rel=0.03)
    assert area_cm2(mesh) == pytest.approx(ellipsoid.area_cm2, rel=0.03)
    values, gradients = ellipsoid.logits_and_gradients(mesh.vertices)
    slope = np.linalg.norm(gradients, axis=1)
    assert np.abs(values / slope).max() < 0.02
    np.testing.assert_allclose(mesh.normals, -gradients / slope[:, None], atol=0.05)


def test_volume_converges_with_the_square_of_the_step():
    steps = np.array([2.0, 1.0, 0.5])
    truth = ellipsoid_of(LATENT, POSE).volume_ml
    errors = [abs(volume_ml(surface_of(MODEL, LATENT, POSE, step)) - truth) for step in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 1.7 < slope < 2.3


def test_step_is_measured_in_the_world():
    small, large = (surface_of(MODEL, LATENT, Pose(log_scale=s), 1.0) for s in (0.4, -0.4))
    world_density = [len(mesh.faces) / area_cm2(mesh) for mesh in (small, large)]
    assert world_density[0] == pytest.approx(world_density[1], rel=0.1)


def test_own_step_is_the_manifests():
    own, named = surface_of(MODEL, LATENT, POSE), surface_of(MODEL, LATENT, POSE, MODEL.manifest.resolution_mm)
    np.testing.assert_array_equal(own.vertices, named.vertices)


@pytest.mark.parametrize("mirrored", [False, True])
def test_pose_moves_the_very_same_mesh(mirrored):
    model = bent_model()
    canonical = surface_of(model, LATENT, Pose(), 1.0)
    pose = Pose(POSE.position, POSE.rotation, 0.0, mirrored)
    mesh = surface_of(model, LATENT, pose, 1.0)
    np.testing.assert_allclose(mesh.vertices, pose.to_world(canonical.vertices), atol=1e-9)
    assert volume_ml(mesh) == pytest.approx(volume_ml(canonical), rel=1e-9)
    assert volume_ml(mesh) > 0


def test_bending_keeps_the_volume():
    straight, bent = (surface_of(model, LATENT, POSE, 0.5) for model in (MODEL, bent_model()))
    assert volume_ml(bent) == pytest.approx(volume_ml(straight), rel=0.01)


def test_box_is_the_training_shapes_and_a_margin():
    np.testing.assert_allclose(canonical_box(MODEL), np.array(MODEL.manifest.half_extent_mm) + BOX_MARGIN_MM)


def test_shape_beyond_the_box_is_capped_there():
    mesh = surface_of(MODEL, np.array([8.0, 0.0, 0.0]), Pose())
    assert is_watertight(mesh)
    assert np.abs(mesh.vertices).max() < canonical_box(MODEL).max() + 2.0 * MODEL.manifest.resolution_mm


def test_shape_that_is_nowhere_gives_an_empty_mesh():
    assert surface_of(MODEL, np.full(3, -60.0), Pose(np.full(3, 0.3)), 1.7).is_empty


@pytest.mark.parametrize("spacing", [0.7, 3.0])
def test_covering_grid_leaves_the_margin_on_all_sides(spacing):
    mesh = surface_of(MODEL, LATENT, POSE)
    grid = covering_grid(mesh, spacing, margin_mm=4.0)
    lower, upper = extents(mesh)
    first, last = grid.to_world(np.array([[0.0, 0.0, 0.0], np.array(grid.shape) - 1.0]))
    np.testing.assert_allclose(first, lower - 4.0)
    assert (last >= upper + 4.0 - 1e-9).all()
    assert (last < upper + 4.0 + spacing).all()
    np.testing.assert_allclose(grid.spacing, spacing)


@pytest.mark.parametrize("fidelity", [0.0, 0.7])
def test_a_differentiated_surface_is_the_same_and_knows_the_field_at_its_vertices(fidelity):
    found = few_planes.fitted(fidelity)
    mesh, derivatives = differentiated_surface(few_planes.MODEL, found, 0.7)
    plain = surface_of(few_planes.MODEL, found.latent, found.pose, 0.7, found.discrepancy)
    np.testing.assert_array_equal(mesh.faces, plain.faces)
    np.testing.assert_allclose(mesh.vertices, plain.vertices, atol=1e-5)
    np.testing.assert_allclose(mesh.normals, plain.normals, atol=1e-4)
    anew, known = (fitted_jacobians(few_planes.MODEL, found, mesh.vertices, one) for one in (None, derivatives))
    assert np.abs(known[0]).max() < 0.01 * np.linalg.norm(anew[2], axis=1).min()  # within 0.01 mm of the surface
    for there, here in zip(anew[1:], known[1:], strict=True):
        assert np.abs(there - here).max() < 5e-3 * np.abs(there).max()


def test_derivatives_are_those_of_the_vertices_that_stay_when_specks_go():
    model = replace(MODEL, decoder=SpeckDecoder())
    found = replace(few_planes.fitted(0.0), latent=LATENT, pose=Pose())
    whole = surface_of(model, LATENT, Pose(), 0.7, keep_specks=True)
    mesh, derivatives = differentiated_surface(model, found, 0.7)
    assert len(mesh.vertices) < len(whole.vertices)
    assert len(derivatives.logits) == len(mesh.vertices)
    assert np.abs(derivatives.logits).max() < 0.05
    outward = -derivatives.by_point / np.linalg.norm(derivatives.by_point, axis=1, keepdims=True)
    np.testing.assert_allclose(outward, mesh.normals, atol=1e-6)


def test_nothing_has_no_derivatives():
    found = replace(few_planes.fitted(0.0), latent=np.full(3, -60.0))
    mesh, derivatives = differentiated_surface(MODEL, found)
    assert mesh.is_empty
    assert derivatives is None


@dataclass(frozen=True)
class RecordingDecoder(EllipsoidDecoder):
    """The ellipsoid, and how many points it was asked for each time."""

    sizes: list[int] = field(default_factory=list)

    def logits(self, latent, points):
        self.sizes.append(points.shape[1])
        return super().logits(latent, points)

    def logits_and_jacobians(self, latent, points):
        self.sizes.append(points.shape[1])
        return super().logits_and_jacobians(latent, points)


def test_what_ends_the_work_is_asked_before_every_few_points():
    told, decoder = [], RecordingDecoder()
    model = interruptible(replace(MODEL, decoder=decoder), lambda: told.append(None))
    mesh = surface_of(model, LATENT, POSE, 0.2)
    assert len(mesh.vertices) > 2 * CHUNK
    assert max(decoder.sizes) <= CHUNK
    assert len(told) == len(decoder.sizes)
    values, gradients = ellipsoid_of(LATENT, POSE).logits_and_gradients(mesh.vertices)
    assert np.abs(values / np.linalg.norm(gradients, axis=1)).max() < 0.005
