"""What was trained on is told from what was not, by digests in the manifest."""

import json
from dataclasses import replace

import numpy as np
import pytest

from model.bundle import read_manifest, write_manifest
from model.errors import InvalidParameter
from model.geometry import Grid
from model.networks.decoder import DecoderShape
from model.networks.flow import FlowShape
from model.networks.prior import PriorShape
from tests.ellipsoid_cohort import GRID, ellipsoids
from training.cohorts import Case
from training.cohorts.cohort import Cohort, Provenance, listed
from training.cohorts.inspect import voxel_digest
from training.completion.release import complete_bundle
from training.config import TrainingConfig
from training.evaluate import shipped_bundles
from training.runs import RECORD, prepare, record
from training.seen import DIGITS, check_seen, check_uncalibrated, check_unseen, is_among, short_digest

CASES = tuple(Case(f"e{n}", f"e{n}", "train", shape.mask(GRID), GRID) for n, shape in enumerate(ellipsoids(6)))
BEFORE = replace(read_manifest(shipped_bundles() / "talus")[0], training_masks=())
MANIFEST = replace(BEFORE, training_masks=tuple(short_digest(case) for case in CASES[:4]))


def test_shapes_of_the_training_are_not_measured_on_and_others_are():
    check_unseen(MANIFEST, CASES[4:])
    with pytest.raises(InvalidParameter, match="trained on e3, which is to be among the test cases; --seed") as caught:
        check_unseen(MANIFEST, CASES[3:], "test")
    assert caught.value.part == "cohort"


def test_shapes_of_the_calibration_are_not_tested_on():
    calibrated = replace(MANIFEST, calibration={"masks": [short_digest(CASES[4])]})
    check_uncalibrated(calibrated, CASES[5:])
    check_uncalibrated(MANIFEST, CASES)
    with pytest.raises(InvalidParameter, match="calibrated on e4, which is to be among the test cases"):
        check_uncalibrated(calibrated, CASES[4:])


def test_shapes_beyond_the_training_are_not_learnt_from():
    check_seen(MANIFEST, CASES[:4])
    with pytest.raises(InvalidParameter, match="was not trained on e4, e5, which the network"):
        check_seen(MANIFEST, CASES)


def test_of_a_model_without_digests_nothing_is_known():
    check_unseen(BEFORE, CASES)
    check_seen(BEFORE, CASES)


def test_a_shape_is_known_in_another_place_in_another_crop_and_with_specks():
    case = CASES[0]
    place = np.linalg.inv(GRID.affine)
    speck = case.mask.copy()
    speck[0, 0, 0] = True
    crop = case.mask[:, 1:, :]
    others = (
        replace(case, grid=Grid(GRID.shape, place)),
        replace(case, mask=speck),
        replace(case, mask=crop, grid=Grid((25, 24, 25), GRID.affine)),
    )
    for other in others:
        with pytest.raises(InvalidParameter, match="e0"):
            check_unseen(MANIFEST, [other])


def stored_backwards(case):
    """The same shape with its axes in another order and two of them backwards."""
    affine = case.grid.affine.copy()
    last = np.array(case.mask.shape) - 1.0
    affine[:3, :3] = case.grid.affine[:3, :3] @ np.array([[0, -1, 0], [-1, 0, 0], [0, 0, 1.0]])
    affine[:3, 3] = case.grid.to_world(np.array([[last[0], last[1], 0.0]]))[0]
    mask = np.ascontiguousarray(case.mask.transpose(1, 0, 2)[::-1, ::-1])
    return replace(case, mask=mask, grid=Grid(mask.shape, affine))


def test_a_shape_is_known_however_its_axes_are_stored():
    bump = CASES[0].mask.copy()
    bump[12:15, 3:8, 10:12] = True
    case = replace(CASES[0], mask=bump)
    other = stored_backwards(case)
    known = {short_digest(case)}
    assert not np.array_equal(case.mask, other.mask)
    assert is_among(case, known)
    assert is_among(other, known)
    mirrored = replace(case, grid=Grid(GRID.shape, np.diag([-1.0, 1.0, 1.0, 1.0])))
    larger = replace(case, grid=Grid(GRID.shape, np.diag([1.2, 1.2, 1.2, 1.0])))
    turned = replace(case, grid=Grid(GRID.shape, np.diag([-1.0, -1.0, 1.0, 1.0])), stored=case.grid)
    assert [is_among(one, known) for one in (mirrored, larger, turned)] == [False, False, True]


def test_digests_of_bare_arrays_are_still_looked_for():
    """They stand in manifests and runs of earlier versions, of masks whose axes ran along R, A and S."""
    bump = CASES[0].mask.copy()
    bump[12:15, 3:8, 10:12] = True
    case = replace(CASES[0], mask=bump)
    before = replace(BEFORE, training_masks=(voxel_digest(case.mask)[:DIGITS],))
    for one in (case, stored_backwards(case)):
        with pytest.raises(InvalidParameter, match="trained on e0"):
            check_unseen(before, [one])
        check_seen(before, [one])
    check_unseen(before, CASES[1:])


def test_the_manifest_keeps_digests_and_no_names(tmp_path):
    write_manifest(MANIFEST, tmp_path)
    assert read_manifest(tmp_path)[0] == MANIFEST
    assert all(len(word) == DIGITS and int(word, 16) >= 0 for word in MANIFEST.training_masks)
    assert "training_masks" not in json.dumps(MANIFEST.training)


def test_long_lists_are_cut_short():
    assert listed(["a", "b", "c"]) == "a, b, c"
    assert listed([*"abcdef"]) == "a, b, c and 3 more"


def cohort(cases):
    return Cohort("ellipsoids", cases, (), (), (), Provenance("made here", "CC0-1.0", "nobody", shippable=True))


def test_completion_refuses_before_it_trains(tmp_path):
    write_manifest(MANIFEST, tmp_path)
    with pytest.raises(InvalidParameter, match="was not trained on"):
        complete_bundle(tmp_path, cohort(CASES), tmp_path / "run", steps=1)
    assert not (tmp_path / "run").exists()


def test_a_run_that_recorded_no_voxels_is_continued(tmp_path):
    config = TrainingConfig(
        DecoderShape(latent_size=3, width=8, depth=2), PriorShape(FlowShape(latent_size=3)), steps=1
    )
    prepare(cohort(CASES[:3]), config, tmp_path)
    values = json.loads((tmp_path / RECORD).read_text(encoding="utf-8"))
    assert values.pop("voxel_digests") == [short_digest(case) for case in CASES[:3]]
    (tmp_path / RECORD).write_text(json.dumps(values), encoding="utf-8")
    prepare(cohort(CASES[:3]), config, tmp_path, resume=True)
    values["voxel_digests"] = [voxel_digest(case.mask)[:DIGITS] for case in CASES[:3]]
    (tmp_path / RECORD).write_text(json.dumps(values), encoding="utf-8")
    prepare(cohort(CASES[:3]), config, tmp_path, resume=True)
    assert record(cohort(CASES[:3]), config)["voxel_digests"]
