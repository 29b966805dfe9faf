"""Parts of a mesh beyond a face that cuts the object off, of balls and boxes of known volume."""

import numpy as np
import pytest
import trimesh

from model.geometry import Grid
from model.inference.mesh import Mesh
from training.cohorts.cohort import Case
from training.field_of_view import in_view, volume_out_of_view_ml

RADIUS = 20.0
#: Voxels of 2 x 1 x 1 mm, turned and off the origin; the ball's centre is that of the grid's face k = last.
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SPACING = np.array([2.0, 1.0, 1.0])


def grid(depth: int) -> Grid:
    affine = np.eye(4)
    affine[:3, :3] = TURN * SPACING
    affine[:3, 3] = (70.0, -30.0, 5.0)
    return Grid((31, 61, depth), affine)


def ball(centre_index: tuple[float, float, float], on: Grid) -> Mesh:
    found = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    vertices = np.asarray(found.vertices) + on.to_world(np.array([centre_index]))
    return Mesh(vertices, np.asarray(found.faces), np.asarray(found.vertices) / RADIUS, {})


def shown(mesh: Mesh, on: Grid) -> Case:
    """What a crop shows of a ball."""
    centre = mesh.vertices.mean(axis=0)
    return Case("ball", "", "test", (np.linalg.norm(on.centres() - centre, axis=1) <= RADIUS).reshape(on.shape), on)


@pytest.mark.parametrize("hidden_mm", [5.0, 20.0, 30.0])
def test_the_cap_beyond_a_face_that_cuts_is_out_of_view(hidden_mm):
    on = grid(60)
    mesh = ball((15.0, 30.0, 59.5 - RADIUS + hidden_mm), on)
    case = shown(mesh, on)
    cap = np.pi * hidden_mm**2 * (RADIUS - hidden_mm / 3.0) / 1000.0
    assert volume_out_of_view_ml(case, mesh) == pytest.approx(cap, rel=0.03)
    assert np.array_equal(in_view(case, mesh.vertices), on.to_index(mesh.vertices)[:, 2] <= 59.5)


def test_a_mesh_that_leaves_a_crop_which_holds_the_object_is_wrong_there():
    on = grid(60)
    mesh = ball((15.0, 30.0, 50.0), on)
    case = shown(ball((15.0, 30.0, 30.0), on), on)
    assert not case.mask[:, :, -1].any()
    assert in_view(case, mesh.vertices).all()
    assert volume_out_of_view_ml(case, mesh) == 0.0


def test_faces_that_do_not_cut_hide_nothing():
    """Cut at its first voxels along k, the mesh is also too far along i: that is an error."""
    on = grid(60)
    case = shown(ball((15.0, 30.0, 0.0), on), on)
    moved = ball((28.0, 30.0, 30.0), on)
    assert on.to_index(moved.vertices)[:, 0].max() > 31.0
    assert in_view(case, moved.vertices).all()
    assert volume_out_of_view_ml(case, moved) == 0.0
