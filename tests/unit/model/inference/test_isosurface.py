import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from model.errors import InvalidParameter
from model.inference.isosurface import extract_surface
from model.inference.mesh import area_cm2, components, is_watertight, largest_component, to_trimesh, volume_ml
from tests.analytic_shapes import Box, Ellipsoid, Torus, sphere
from tests.dense_fields import surface_of_nodes

LOW, HIGH = np.full(3, -30.0), np.full(3, 30.0)
TURN = Rotation.from_rotvec([0.3, 0.5, 0.2]).as_matrix()
CENTRE = (0.31, 0.17, -0.23)


def counted(field):
    calls = []

    def asked(points):
        calls.append(len(points))
        return field(points)

    return asked, calls


def dense(field, step):
    axis = np.arange(-30.0, 30.0 + step / 2, step)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    values = field(points).reshape(len(axis), len(axis), len(axis)).astype(np.float32)
    return largest_component(surface_of_nodes(values, LOW, step))[0]


SHAPES = {
    "ellipsoid": Ellipsoid((7.0, 9.0, 20.0), np.array(CENTRE), TURN).logits,
    "saturated ellipsoid": lambda p: 8.0 * np.tanh(Ellipsoid((7.0, 9.0, 20.0)).logits(p) / 2.0),
    "steep ellipsoid": lambda p: 50.0 * Ellipsoid((7.0, 9.0, 20.0)).logits(p),
    "small ball": sphere(1.7, CENTRE).logits,
    "torus": lambda p: Torus(15.0, 1.5).logits(p @ TURN),
    "plate": lambda p: Box((15.0, 12.0, 0.75), np.array(CENTRE)).logits(p @ TURN),
    "rod": lambda p: Box((15.0, 1.5, 1.5), np.array(CENTRE)).logits(p @ TURN),
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("factor", [None, 2, 4, 8])
def test_refinement_finds_the_surface_of_the_dense_grid(name, factor):
    field, calls = counted(SHAPES[name])
    mesh = extract_surface(field, LOW, HIGH, 1.0, coarse_factor=factor)
    whole = dense(SHAPES[name], 1.0)
    np.testing.assert_array_equal(mesh.faces, whole.faces)
    np.testing.assert_allclose(mesh.vertices, whole.vertices, atol=1e-3)
    assert len(calls) <= 6


@pytest.mark.parametrize(("step", "share"), [(1.0, 10), (0.5, 20)])
def test_refinement_evaluates_a_small_share_of_the_nodes(step, share):
    field, calls = counted(Ellipsoid((7.0, 9.0, 20.0)).logits)
    extract_surface(field, LOW, HIGH, step)
    assert sum(calls) * share < (60.0 / step + 1) ** 3
    assert len(calls) <= 6


def test_error_falls_with_the_square_of_the_step():
    ball = sphere(10.0, CENTRE)
    steps = np.array([2.0, 1.0, 0.5])
    box = np.full(3, 14.0)
    errors = []
    for step in steps:
        mesh = extract_surface(ball.logits, -box, box, step)
        errors.append(np.abs(np.linalg.norm(mesh.vertices - CENTRE, axis=1) - 10.0).max())
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.1)
    assert errors[-1] < 0.004


def test_gradient_puts_vertices_and_normals_onto_the_surface():
    ball = sphere(10.0, CENTRE)
    mesh = extract_surface(ball.logits, np.full(3, -13.0), np.full(3, 13.0), 1.0, gradient=ball.logits_and_gradients)
    outward = (mesh.vertices - CENTRE) / 10.0
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(mesh.normals, outward, atol=2e-3)
    assert is_watertight(mesh)


def test_gradient_makes_vertices_of_a_curved_field_fourth_order_accurate():
    shape = Ellipsoid((7.0, 9.0, 20.0), np.array(CENTRE), TURN)
    errors = []
    for step in (4.0, 2.0):
        mesh = extract_surface(shape.logits, LOW, HIGH, step, gradient=shape.logits_and_gradients)
        errors.append(np.abs(shape.logits(mesh.vertices)).max())
    assert errors[1] < errors[0] / 8.0
    assert errors[1] < 1e-3


def test_volume_and_area_come_close_to_the_exact_ones():
    shape = Ellipsoid((7.0, 9.0, 20.0), np.array(CENTRE), TURN)
    mesh = extract_surface(shape.logits, LOW, HIGH, 0.5, gradient=shape.logits_and_gradients)
    assert volume_ml(mesh) == pytest.approx(shape.volume_ml, rel=2e-3)
    assert area_cm2(mesh) == pytest.approx(shape.area_cm2, rel=2e-3)


@pytest.mark.parametrize("with_gradient", [False, True])
def test_object_through_the_border_is_capped(with_gradient):
    ball = sphere(10.0, (6.0, 0.0, 0.0))
    box = np.full(3, 8.0)
    gradient = ball.logits_and_gradients if with_gradient else None
    mesh = extract_surface(ball.logits, -box, box, 1.0, gradient=gradient)
    assert is_watertight(mesh)
    assert volume_ml(mesh) > 0
    assert (np.abs(mesh.vertices) <= 8.5 + 1e-9).all()
    assert mesh.vertices[:, 0].max() == pytest.approx(8.5)


def test_torus_keeps_its_hole():
    torus = Torus(12.0, 4.0)
    mesh = extract_surface(torus.logits, np.full(3, -18.0), np.full(3, 18.0), 0.5)
    assert to_trimesh(mesh).euler_number == 0
    assert volume_ml(mesh) == pytest.approx(torus.volume_ml, rel=5e-3)


def two_balls(points):
    return np.maximum(sphere(9.0).logits(points), sphere(2.0, (16.0, 0.0, 0.0)).logits(points))


def test_specks_go_unless_kept():
    alone = extract_surface(two_balls, LOW, HIGH, 1.0)
    both = extract_surface(two_balls, LOW, HIGH, 1.0, keep_specks=True)
    assert components(alone)[0] == 1
    assert components(both)[0] == 2
    assert largest_component(both)[1] == 1
    assert alone.vertices[:, 0].max() < 10.0


def test_nothing_inside_gives_an_empty_mesh():
    assert extract_surface(lambda p: np.full(len(p), -3.0), LOW, HIGH, 4.0).is_empty


def test_everything_inside_gives_the_box():
    mesh = extract_surface(lambda p: np.full(len(p), 3.0), LOW, HIGH, 4.0)
    assert is_watertight(mesh)
    np.testing.assert_allclose([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)], [LOW - 2.0, HIGH + 2.0])


ROUNDED = {
    "as it is": lambda values: values,
    "whole numbers": lambda values: np.round(2.0 * values / values.std()),
    "signs": np.sign,
}


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.7, 1.2]), st.sampled_from(sorted(ROUNDED)))
def test_noise_gives_closed_manifold_surfaces(seed, blur, rounding):
    values = gaussian_filter(np.random.default_rng(seed).normal(size=(9, 8, 7)), blur)
    mesh = surface_of_nodes(ROUNDED[rounding](values).astype(np.float32), np.zeros(3), 1.0)
    assert is_watertight(mesh)
    assert volume_ml(mesh) > 0


@given(st.integers(0, 2**32 - 1))
def test_turned_field_gives_the_turned_surface(seed):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    shape = Ellipsoid((5.0, 6.0, 9.0), rotation=turn)
    box = np.full(3, 11.0)
    mesh = extract_surface(shape.logits, -box, box, 1.0, gradient=shape.logits_and_gradients)
    inertia = to_trimesh(mesh).moment_inertia
    expected = shape.volume_ml * 1000.0 / 5.0 * turn @ np.diag([36.0 + 81.0, 25.0 + 81.0, 25.0 + 36.0]) @ turn.T
    np.testing.assert_allclose(inertia, expected, atol=0.03 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("low", "high", "step", "factor", "part"),
    [
        (LOW, HIGH, 0.0, 4, "resolution_mm"),
        (LOW, HIGH, float("nan"), 4, "resolution_mm"),
        (HIGH, LOW, 1.0, 4, "box"),
        (LOW, HIGH, 1.0, 3, "coarse_factor"),
    ],
)
def test_impossible_grids_are_refused(low, high, step, factor, part):
    with pytest.raises(InvalidParameter) as refusal:
        extract_surface(sphere(3.0).logits, low, high, step, coarse_factor=factor)
    assert refusal.value.part == part
