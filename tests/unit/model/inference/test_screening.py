"""Starts among many places of the mean shape: they follow the drawing, and save fits that the centroid leads astray."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.bundle import open_bundle
from model.geometry import Pose
from model.inference.fitting import FitOptions, fit, fit_from
from model.inference.observations import Observations, Plane
from model.inference.screening import APART, KEPT, screened_poses
from model.inference.starts import Start, starting_poses
from tests.analytic_model import bent_model
from tests.drawn_shapes import rotation

BENT = bent_model()
PLAIN = FitOptions(robust=False)
HALF = np.asarray(BENT.manifest.half_extent_mm)


def sections_of(model, count, seed, *, step=1.5, pose=None):
    """The mean shape on random planes; labels are exact."""
    random = np.random.default_rng(seed)
    pose = Pose() if pose is None else pose
    half = np.asarray(model.manifest.half_extent_mm)
    reach = np.arange(-half.max(), half.max() + step, step)
    across = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    sections = []
    while len(sections) < count:
        normal = random.normal(size=3)
        normal /= np.linalg.norm(normal)
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        offset = random.uniform(-0.6, 0.6) * (np.abs(normal) @ half)
        points = offset * normal + across @ np.stack([first, np.cross(normal, first)])
        points = points[(np.abs(points) <= half).all(axis=1)]
        if len(points):
            code = np.zeros((1, model.manifest.latent_size), np.float32)
            labels = model.decoder.logits(code, points[None].astype(np.float32))[0] > 0
            if labels.sum() >= 15:
                sections.append((points, labels))
    points = pose.to_world(np.concatenate([points for points, _ in sections]))
    labels = np.concatenate([labels for _, labels in sections]).astype(float)
    numbers = np.repeat(np.arange(count), [len(points) for points, _ in sections])
    planes = tuple(Plane(number, 0, 0) for number in range(count))
    return Observations(points, labels, np.full(len(points), step**2), planes, numbers)


def test_the_best_place_is_close_to_where_the_shape_lies():
    true = Pose(np.array([30.0, -20.0, 50.0]))
    observations = sections_of(BENT, 3, 0, pose=true)
    start = replace(true, position=true.position + 0.6 * HALF)
    best = screened_poses(BENT, observations, start, 0.3)[0]
    assert np.linalg.norm((best.position - true.position) / HALF) < 0.3


@given(st.integers(0, 50))
@settings(max_examples=20)
def test_places_lie_apart(seed):
    poses = screened_poses(BENT, sections_of(BENT, 2, seed, step=2.0), Pose(), 0.3)
    assert 1 <= len(poses) <= KEPT
    for number, pose in enumerate(poses):
        for other in poses[:number]:
            assert np.linalg.norm(pose.rotation @ (pose.position - other.position) / HALF) > APART


def test_a_turned_drawing_has_turned_starts():
    turn, shift = rotation(70.0, (1.0, -2.0, 0.5)), np.array([5.0, -40.0, 12.0])
    observations = sections_of(BENT, 2, 3)
    turned = replace(observations, points=observations.points @ turn.T + shift)
    plain = screened_poses(BENT, observations, Pose(), 0.3)
    for here, there in zip(plain, screened_poses(BENT, turned, Pose(shift, turn.T), 0.3), strict=True):
        np.testing.assert_allclose(there.position, turn @ here.position + shift, atol=1e-9)
        np.testing.assert_allclose(there.rotation, here.rotation @ turn.T, atol=1e-9)


@pytest.fixture(scope="module")
def talus(shipped_bundles):
    (bundle,) = (bundle for bundle in shipped_bundles if bundle.name == "talus")
    return open_bundle(bundle, threads=1)


def fit_from_the_usual_start(model, observations):
    """The fit that starts at the centroid of the drawing alone."""
    pose = starting_poses(observations, PLAIN)[0]
    return fit_from(model, observations, [Start(pose, pose)], PLAIN)


def fit_from_the_truth(model, observations):
    """The fit that starts where the shape lies, which is the origin; its code makes up for a part of a mm."""
    found = fit_from(model, observations, [Start(Pose(), starting_poses(observations, PLAIN)[0])], PLAIN)
    assert np.linalg.norm(found.pose.position) < 1.5
    return found


def apart_mm(one, other):
    return np.linalg.norm(one.pose.position - other.pose.position)


@pytest.mark.parametrize("seed", [2, 13, 15, 16, 35, 39])
def test_a_mean_shape_on_two_planes_is_found(talus, seed):
    observations = sections_of(talus, 2, seed)
    true, usual = fit_from_the_truth(talus, observations), fit_from_the_usual_start(talus, observations)
    assert apart_mm(usual, true) > 4.0
    assert usual.objective > true.objective + 100.0
    found = fit(talus, observations, PLAIN)
    assert apart_mm(found, true) < 0.1
    assert found.objective < true.objective + 0.1


def test_starts_are_looked_for_on_more_planes_when_asked(talus):
    observations = sections_of(talus, 3, 35, step=2.0)
    true, usual = fit_from_the_truth(talus, observations), fit(talus, observations, PLAIN)
    assert apart_mm(usual, true) > 4.0
    assert usual.objective > true.objective + 100.0
    found = fit(talus, observations, replace(PLAIN, screened=True))
    assert apart_mm(found, true) < 0.1
    assert found.objective < true.objective + 0.1
