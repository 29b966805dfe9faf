"""Where to draw next: what is expected of a plane is what a fit with that plane finds."""

from dataclasses import replace

import numpy as np
import pytest

from model.errors import InvalidParameter
from model.inference.discrepancy.conditioning import DiscrepancyPrior, with_discrepancy
from model.inference.fitting import FitOptions, fit
from model.inference.mask_stack import Plane
from model.inference.mesh import vertex_areas
from model.inference.next_plane import Judge, next_plane
from model.inference.posterior import laplace_covariance
from model.inference.section_curves import Cut, free_cuts, grid_cuts, nearby_cuts, reached, section_curve
from model.inference.surface import surface_of
from model.inference.uncertainty import ShapeState, surface_spread
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import cube_around, drawn, observed

CENTRE = np.array([30.0, -20.0, 50.0])
GRID = cube_around(CENTRE)
SHAPE = Ellipsoid((13.0, 9.0, 6.5), CENTRE)
#: So little trust in a drawn mm^2 that three planes leave much open.
MODEL = replace(ellipsoid_model(), manifest=replace(ellipsoid_model().manifest, likelihood_precision=0.05))
MIDDLE = round(float(GRID.to_index(CENTRE[None])[0, 0]))
START = (Plane(0, 2, MIDDLE), Plane(0, 2, MIDDLE + 2))


def answer(planes, fidelity):
    stack = drawn(SHAPE, GRID, planes)
    observations = observed(stack, planes)
    found = fit(MODEL, observations, FitOptions(robust=False))
    found = with_discrepancy(MODEL, found, [stack], observations, DiscrepancyPrior(0.6, fidelity))
    return found, surface_of(MODEL, found.latent, found.pose, 1.0, found.discrepancy)


def mean_sd(found, mesh):
    spread = surface_spread(MODEL, ShapeState((found,), laplace_covariance(found)), mesh)
    areas = vertex_areas(mesh)
    return float(areas @ spread.sd() / areas.sum()), spread.sd_of(areas)


@pytest.mark.parametrize("fidelity", [0.0, 0.5])
@pytest.mark.parametrize("plane", [Plane(0, 0, MIDDLE), Plane(0, 1, MIDDLE - 4), Plane(0, 2, MIDDLE - 4)])
def test_the_expected_gain_is_that_of_drawing_the_plane(fidelity, plane):
    found, mesh = answer(START, fidelity)
    (judged,) = Judge(MODEL, found, mesh).judged(grid_cuts(mesh, GRID, plane.axis, [plane.index]))
    before, after = mean_sd(found, mesh), mean_sd(*answer((*START, plane), fidelity))
    assert judged.surface_share == pytest.approx(after[0] / before[0], abs=0.12)
    assert judged.volume_share == pytest.approx(after[1] / before[1], abs=0.15)


def test_a_plane_tells_less_where_the_drawing_was_trusted_less():
    found, mesh = answer(START, 0.5)
    cuts = grid_cuts(mesh, GRID, 0, [MIDDLE])
    trusted, rough = (Judge(MODEL, replace(found, trust=trust), mesh).judged(cuts)[0] for trust in (1.0, 0.1))
    assert trusted.surface_share < rough.surface_share < 1.0


@pytest.mark.parametrize("among", ["grid", "free"])
def test_the_plane_is_better_than_any_that_was_considered(among):
    found, mesh = answer(START, 0.5)
    chosen = next_plane(MODEL, found, mesh, GRID, START, among)
    assert 0.0 < chosen.surface_share < 1.0
    assert 0.0 < chosen.volume_share < 1.0
    assert np.linalg.norm(chosen.cut.normal) == pytest.approx(1.0)
    assert np.abs(chosen.cut.origin - CENTRE).max() < 13.0
    # Two planes across S say least of what lies along it: the next one is no third of them beside them.
    others = Judge(MODEL, found, mesh).judged(grid_cuts(mesh, GRID, 2, [MIDDLE + 1, MIDDLE + 3]))
    assert all(chosen.surface_share < other.surface_share for other in others)


def test_a_plane_of_the_grid_is_named_and_not_drawn_before():
    found, mesh = answer(START, 0.5)
    drawn_planes = list(START)
    for _ in range(3):
        chosen = next_plane(MODEL, found, mesh, GRID, drawn_planes).cut.plane
        assert chosen is not None
        assert chosen not in drawn_planes
        assert chosen.index in reached(mesh, GRID, chosen.axis)
        drawn_planes.append(chosen)


def test_nothing_is_left_when_all_planes_are_drawn():
    found, mesh = answer(START, 0.5)
    everything = [Plane(0, axis, index) for axis in range(3) for index in reached(mesh, GRID, axis)]
    with pytest.raises(InvalidParameter, match="planes=free"):
        next_plane(MODEL, found, mesh, GRID, everything)
    assert next_plane(MODEL, found, mesh, GRID, everything, "free").cut.plane is None


def test_a_plane_beside_the_surface_gains_nothing():
    found, mesh = answer(START, 0.5)
    far = Cut(CENTRE + np.array([100.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    assert Judge(MODEL, found, mesh).judged([far]) == []


def test_section_of_a_ball_is_a_circle():
    mesh = surface_of(ellipsoid_model(mean_axes=(10.0, 10.0, 10.0)), np.zeros(3), answer(START, 0.0)[0].pose, 1.0)
    centre = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    radius = 0.5 * float(np.ptp(mesh.vertices, axis=0).mean())
    for height in (0.0, 3.0, 7.0):
        for cut in free_cuts(mesh, 5, [0.5]):
            moved = Cut(centre + height * cut.normal, cut.normal)
            curve = section_curve(mesh, moved, 0.5)
            expected = np.sqrt(radius**2 - height**2)
            assert curve.lengths.sum() == pytest.approx(2.0 * np.pi * expected, rel=0.02)
            assert np.abs((curve.points - moved.origin) @ cut.normal).max() < 1e-6
            np.testing.assert_allclose(np.linalg.norm(curve.points - moved.origin, axis=1), expected, rtol=0.02)


def test_coarser_cells_keep_the_length():
    _, mesh = answer(START, 0.0)
    for cut in free_cuts(mesh, 7, [0.3, 0.6]):
        fine, coarse = (section_curve(mesh, cut, spacing) for spacing in (0.5, 4.0))
        assert coarse.lengths.sum() == pytest.approx(fine.lengths.sum())
        assert len(coarse.lengths) < len(fine.lengths)


def test_nearby_planes_are_near_and_units():
    _, mesh = answer(START, 0.0)
    (cut,) = free_cuts(mesh, 1, [0.5])
    near = nearby_cuts(mesh, cut, 0.2, 0.1)
    assert len(near) == 6
    for other in near:
        assert np.linalg.norm(other.normal) == pytest.approx(1.0)
        assert np.arccos(np.clip(other.normal @ cut.normal, -1.0, 1.0)) <= 0.2 + 1e-6


def test_a_grid_that_runs_the_other_way_names_the_same_plane():
    affine = GRID.affine.copy()
    affine[:3, 0] *= -1.0
    affine[:3, 3] = GRID.to_world(np.array([[GRID.shape[0] - 1.0, 0.0, 0.0]]))[0]
    found, mesh = answer(START, 0.5)
    here, there = (next_plane(MODEL, found, mesh, grid, START) for grid in (GRID, replace(GRID, affine=affine)))
    assert there.surface_share == pytest.approx(here.surface_share, abs=0.02)
