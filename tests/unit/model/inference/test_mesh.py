import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.inference.isosurface import extract_surface
from model.inference.mesh import (
    Mesh,
    area_cm2,
    empty_mesh,
    extents,
    is_watertight,
    largest_component,
    mesh_of,
    to_trimesh,
    transformed,
    vertex_areas,
    vertex_normals,
    volume_ml,
)
from tests.analytic_shapes import Box, Ellipsoid, sphere, spheroid_area_cm2

SHAPE = Ellipsoid((5.0, 6.0, 9.0), np.array([40.0, -20.0, 15.0]))
LOW, HIGH = np.array([30.0, -30.0, 2.0]), np.array([50.0, -10.0, 28.0])


@pytest.fixture(scope="module")
def ellipsoid() -> Mesh:
    mesh = extract_surface(SHAPE.logits, LOW, HIGH, 0.5, gradient=SHAPE.logits_and_gradients)
    return mesh.with_scalars(surface_sd_mm=mesh.vertices[:, 2] / 10.0)


def similarity(seed, mirrored):
    rng = np.random.default_rng(seed)
    affine = np.eye(4)
    flip = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0])
    scale = rng.uniform(0.5, 2.0)
    affine[:3, :3] = scale * Rotation.random(rng=rng).as_matrix() @ flip
    affine[:3, 3] = rng.uniform(-50.0, 50.0, 3)
    return affine, scale


def test_area_of_a_spheroid_agrees_with_quadrature():
    assert Ellipsoid((4.0, 4.0, 9.0)).area_cm2 == pytest.approx(spheroid_area_cm2(4.0, 9.0), rel=1e-9)
    assert Ellipsoid((9.0, 4.0, 9.0)).area_cm2 == pytest.approx(spheroid_area_cm2(9.0, 4.0), rel=1e-9)
    assert sphere(3.0).area_cm2 == pytest.approx(spheroid_area_cm2(3.0, 3.0), rel=1e-9)


def test_volume_and_area_of_a_box_are_exact():
    box = Box((2.0, 3.0, 5.0), np.array([100.0, 50.0, -20.0]))
    mesh = box.surface
    assert volume_ml(mesh) == pytest.approx(box.volume_ml, rel=1e-12)
    assert area_cm2(mesh) == pytest.approx(box.area_cm2, rel=1e-12)
    np.testing.assert_allclose(extents(mesh), [box.centre - box.half_sizes, box.centre + box.half_sizes])


def test_measures_agree_with_trimesh(ellipsoid):
    other = to_trimesh(ellipsoid)
    assert volume_ml(ellipsoid) == pytest.approx(other.volume / 1000.0)
    assert area_cm2(ellipsoid) == pytest.approx(other.area / 100.0)
    assert is_watertight(ellipsoid)
    assert other.is_watertight


def test_vertex_areas_add_up(ellipsoid):
    areas = vertex_areas(ellipsoid)
    assert areas.shape == (len(ellipsoid.vertices),)
    assert areas.sum() == pytest.approx(100.0 * area_cm2(ellipsoid))
    assert (areas > 0).all()


def test_normals_point_outwards(ellipsoid):
    exact = -SHAPE.logits_and_gradients(ellipsoid.vertices)[1]
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    from_faces = vertex_normals(ellipsoid.vertices, ellipsoid.faces)
    for normals in (ellipsoid.normals, from_faces):
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert np.einsum("ij,ij->i", ellipsoid.normals, exact).min() > 0.999
    assert np.percentile(np.einsum("ij,ij->i", from_faces, exact), 1) > 0.99


@pytest.mark.parametrize("damage", ["hole", "flipped", "doubled"])
def test_damage_is_seen(ellipsoid, damage):
    faces = ellipsoid.faces.copy()
    if damage == "hole":
        faces = faces[1:]
    elif damage == "flipped":
        faces[0] = faces[0, ::-1]
    else:
        faces = np.concatenate([faces, faces[:1]])
    assert not is_watertight(Mesh(ellipsoid.vertices, faces, ellipsoid.normals))


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_similarity_scales_measures_and_keeps_the_outside_outside(ellipsoid, seed, mirrored):
    affine, scale = similarity(seed, mirrored)
    moved = transformed(ellipsoid, affine)
    assert volume_ml(moved) == pytest.approx(scale**3 * volume_ml(ellipsoid), rel=1e-6)
    assert area_cm2(moved) == pytest.approx(scale**2 * area_cm2(ellipsoid), rel=1e-6)
    assert is_watertight(moved)
    agreement = np.einsum("ij,ij->i", moved.normals, vertex_normals(moved.vertices, moved.faces))
    assert np.percentile(agreement, 1) > 0.99


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_inverse_similarity_brings_the_mesh_back(ellipsoid, seed, mirrored):
    affine, _ = similarity(seed, mirrored)
    back = transformed(transformed(ellipsoid, affine), np.linalg.inv(affine))
    np.testing.assert_allclose(back.vertices, ellipsoid.vertices, atol=1e-9)
    np.testing.assert_allclose(back.normals, ellipsoid.normals, atol=1e-12)
    np.testing.assert_array_equal(back.faces, ellipsoid.faces)
    np.testing.assert_array_equal(back.scalars["surface_sd_mm"], ellipsoid.scalars["surface_sd_mm"])


def test_largest_component_keeps_the_larger_solid_and_its_scalars(ellipsoid):
    apart = transformed(ellipsoid, np.diag([0.3, 0.3, 0.3, 1.0]))
    shift = len(apart.vertices)
    both = Mesh(
        np.concatenate([apart.vertices, ellipsoid.vertices]),
        np.concatenate([apart.faces, ellipsoid.faces + shift]),
        np.concatenate([apart.normals, ellipsoid.normals]),
        {"number": np.arange(float(shift + len(ellipsoid.vertices)))},
    )
    kept, removed = largest_component(both)
    assert removed == 1
    np.testing.assert_array_equal(kept.vertices, ellipsoid.vertices)
    np.testing.assert_array_equal(kept.faces, ellipsoid.faces)
    np.testing.assert_array_equal(kept.scalars["number"], np.arange(shift, 2.0 * shift))


def test_cavity_is_filled():
    def shell(points):
        return np.minimum(sphere(10.0).logits(points), -sphere(5.0).logits(points))

    box = np.full(3, 13.0)
    hollow = extract_surface(shell, -box, box, 1.0, keep_specks=True)
    filled, removed = largest_component(hollow)
    assert removed == 1
    assert volume_ml(hollow) == pytest.approx(sphere(10.0).volume_ml - sphere(5.0).volume_ml, rel=0.02)
    assert volume_ml(filled) == pytest.approx(sphere(10.0).volume_ml, rel=0.02)


def test_trimesh_holds_the_same(ellipsoid):
    other = to_trimesh(ellipsoid)
    np.testing.assert_array_equal(other.vertices, ellipsoid.vertices)
    np.testing.assert_array_equal(other.faces, ellipsoid.faces)
    np.testing.assert_allclose(other.vertex_normals, ellipsoid.normals)
    np.testing.assert_array_equal(other.vertex_attributes["surface_sd_mm"], ellipsoid.scalars["surface_sd_mm"])


def test_empty_mesh_has_no_volume_and_is_not_watertight():
    nothing = empty_mesh()
    assert nothing.is_empty
    assert volume_ml(nothing) == 0.0
    assert area_cm2(nothing) == 0.0
    assert not is_watertight(nothing)
    assert mesh_of(nothing.vertices, nothing.faces).is_empty
    assert largest_component(nothing)[1] == 0
