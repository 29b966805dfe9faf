"""Movements from the fit's surface to those of an ensemble's members, against surfaces themselves."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from model.inference.discrepancy.conditioning import observed_anew
from model.inference.ensemble import fit_ensemble
from model.inference.member_moves import member_moves
from model.inference.objective import Place
from model.inference.posterior import fitted_jacobians, fitted_logits
from model.inference.surface import surface_of
from tests.few_planes import MODEL, OBSERVATIONS, fitted


def held(found, latent_step, shift):
    latent, pose = found.latent + latent_step, replace(found.pose, position=found.pose.position + shift)
    (seen,) = observed_anew(MODEL, found, [Place(latent, pose)])
    return replace(found, latent=latent, pose=pose, discrepancy=seen)


def surface(found):
    return surface_of(MODEL, found.latent, found.pose, 0.7, found.discrepancy)


def test_a_member_that_is_shifted_moves_the_surface_along():
    found, shift = fitted(0.0), np.array([0.4, -0.2, 0.1])
    mesh = surface(found)
    moves = member_moves(MODEL, found, [held(found, 0.0, shift)], mesh)
    np.testing.assert_allclose(moves[:, 0], mesh.normals @ shift, atol=0.06)


def test_moves_are_distances_between_the_surfaces():
    """Also of a member whose step is too long for its first order alone."""
    found = fitted(0.0)
    mesh = surface(found)
    member = held(found, np.array([0.5, -0.4, 0.3]), np.array([0.5, 0.0, 0.3]))
    moves = np.abs(member_moves(MODEL, found, [member], mesh)[:, 0])
    distances = cKDTree(surface(member).vertices).query(mesh.vertices)[0]
    far = distances > 0.5  # nearer ones are told by the mesh's own edges
    assert far.sum() > 50
    assert np.abs(moves[far] / distances[far] - 1.0).mean() < 0.25


def test_contours_that_are_trusted_hold_the_members():
    found = fitted(1.0)
    mesh = surface(found)
    members = [held(found, step * np.ones(3), np.zeros(3)) for step in (-0.2, 0.2)]
    near = cKDTree(found.discrepancy.points).query(found.pose.to_canonical(mesh.vertices))[0] < 0.5
    moves = np.abs(member_moves(MODEL, found, members, mesh)).mean(axis=1)
    assert moves[near].mean() < 0.35 * moves[~near].mean()


def test_few_evaluations_tell_what_all_would():
    found = fitted(0.5)
    mesh = surface(found)
    members = [
        held(found, one.latent - found.latent, one.pose.position - found.pose.position) for one in ensemble(found)
    ]
    _, _, by_point = fitted_jacobians(MODEL, found, mesh.vertices)
    logits = np.stack([fitted_logits(MODEL, one, mesh.vertices) for one in members], axis=1)
    everywhere = (logits / np.linalg.norm(by_point, axis=1, keepdims=True)).std(axis=1)
    few = member_moves(MODEL, found, members, mesh).std(axis=1)
    assert np.corrcoef(few, everywhere)[0, 1] > 0.95
    assert abs(np.median(few / everywhere) - 1.0) < 0.05


def ensemble(found):
    return fit_ensemble(MODEL, OBSERVATIONS, found, seed=0, members=8)
