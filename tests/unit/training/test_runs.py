import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from model.errors import InvalidParameter
from model.geometry import Grid
from model.manifest_values import SIDES
from model.networks.decoder import DecoderShape
from model.networks.flow import FlowShape
from model.networks.prior import PriorShape
from tests.analytic_shapes import Ellipsoid
from training.autodecoder import CHECKPOINT
from training.cohorts import Case, Cohort, Provenance
from training.cohorts.cohort import NOT_STATED, SideName
from training.config import TrainingConfig
from training.interruption import Stopped
from training.release import active_dimensions, assembled
from training.runs import RECORD, half_extent, is_finished, mask_digest, read_record, record, train_cohort

GRID = Grid((24, 24, 24), np.diag([1.0, 1.0, 1.0, 1.0]))
CONFIG = TrainingConfig(
    decoder=DecoderShape(latent_size=4, width=16, depth=3),
    prior=PriorShape(FlowShape(latent_size=4, width=8)),
    regime="thin",
    steps=24,
    batch_shapes=3,
    checkpoint_every=8,
)


class Interrupted(Exception):
    """Stands for a killed process."""


def ellipsoids(count=4):
    centre = np.full(3, 11.5)
    shapes = [Ellipsoid((6.0 + 0.5 * n, 7.0, 8.0 - 0.4 * n), centre) for n in range(count)]
    cases = tuple(Case(f"e{n}", f"e{n}", "train", shape.mask(GRID), GRID) for n, shape in enumerate(shapes))
    return Cohort("ellipsoids", cases, (), (), (), Provenance("made here", "CC0", "nobody", shippable=True))


def test_an_interrupted_run_ends_as_an_unbroken_one(tmp_path):
    def interrupt(step, _figures):
        if step == 19:
            raise Interrupted

    unbroken = train_cohort(ellipsoids(), CONFIG, tmp_path / "one")
    with pytest.raises(Interrupted):
        train_cohort(ellipsoids(), CONFIG, tmp_path / "two", watch=interrupt)
    steps = []
    resumed = train_cohort(
        ellipsoids(), CONFIG, tmp_path / "two", resume=True, watch=lambda step, figures: steps.append(step)
    )
    assert steps == list(range(17, 25))
    for name, value in unbroken.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


@pytest.mark.usefixtures("keyboard")
def test_an_interrupt_from_the_keyboard_loses_no_step(tmp_path):
    def interrupt(step, _figures):
        if step == 3:
            signal.raise_signal(signal.SIGINT)

    config, before = replace(CONFIG, steps=5), signal.getsignal(signal.SIGINT)
    unbroken = train_cohort(ellipsoids(), config, tmp_path / "one")
    with pytest.raises(Stopped, match="stopped at step 3 of 5"):
        train_cohort(ellipsoids(), config, tmp_path / "two", watch=interrupt)
    assert signal.getsignal(signal.SIGINT) is before
    steps = []
    resumed = train_cohort(
        ellipsoids(), config, tmp_path / "two", resume=True, watch=lambda step, figures: steps.append(step)
    )
    assert steps == [4, 5]
    for name, value in unbroken.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_a_run_is_not_written_over(tmp_path):
    train_cohort(ellipsoids(), CONFIG, tmp_path)
    with pytest.raises(InvalidParameter, match="--resume"):
        train_cohort(ellipsoids(), CONFIG, tmp_path)


@pytest.mark.parametrize(
    ("cohort", "config"), [(ellipsoids(3), CONFIG), (ellipsoids(), replace(CONFIG, learning_rate=0.1))]
)
def test_a_run_of_other_masks_or_settings_is_not_continued(tmp_path, cohort, config):
    train_cohort(ellipsoids(), CONFIG, tmp_path)
    with pytest.raises(InvalidParameter, match="other masks or settings"):
        train_cohort(cohort, config, tmp_path, resume=True)


def test_the_record_gives_the_configuration_back(tmp_path):
    train_cohort(ellipsoids(), CONFIG, tmp_path)
    config, record = read_record(tmp_path)
    assert config == replace(CONFIG, decoder=config.decoder)
    assert config.decoder.extent_mm >= 8.0
    assert list(record["train"]) == [f"e{n}" for n in range(4)]
    with pytest.raises(InvalidParameter, match="no training run"):
        read_record(tmp_path / "elsewhere")


@pytest.mark.parametrize("name", [RECORD, CHECKPOINT])
@pytest.mark.parametrize("kept", [0.0, 0.5, None])
def test_a_damaged_run_is_told_of_in_one_sentence(tmp_path, name, kept):
    train_cohort(ellipsoids(), CONFIG, tmp_path)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(b"[1, 2]" if kept is None else content[: int(kept * len(content))])
    with pytest.raises(InvalidParameter, match=f"cannot be read, since {name}") as found:
        train_cohort(ellipsoids(), CONFIG, tmp_path, resume=True)
    assert found.value.part == "run"
    with pytest.raises(InvalidParameter, match=f"cannot be read, since {name}"):
        assembled(tmp_path, None)
    with pytest.raises(InvalidParameter, match=f"cannot be read, since {name}"):
        is_finished(tmp_path, ellipsoids(), CONFIG)


def test_no_part_of_a_record_is_left_behind(tmp_path):
    train_cohort(ellipsoids(), CONFIG, tmp_path)
    assert not list(tmp_path.glob("*.part"))


def test_sides_are_recorded_as_manifests_hold_them():
    found = {side: record(replace(ellipsoids(), side=side), CONFIG)["side"] for side in (*SideName, NOT_STATED)}
    assert found == {side: side for side in SIDES} | {NOT_STATED: "mixed"}


def test_a_digest_depends_on_voxels_and_place():
    case = ellipsoids().train[0]
    moved = replace(case, grid=Grid(GRID.shape, np.diag([1.0, 1.0, 2.0, 1.0])))
    other = replace(case, mask=~case.mask)
    assert mask_digest(case) == mask_digest(replace(case, name="renamed"))
    assert len({mask_digest(found) for found in (case, moved, other)}) == 3


def test_the_half_extent_holds_every_shape():
    found = half_extent(ellipsoids())
    assert np.all(np.abs(np.array(found) - [7.5, 7.0, 8.0]) <= 0.5)


@pytest.mark.parametrize(
    ("sigmas", "expected"), [([1.0] * 100, (95, 97, 99)), ([10.0, 1e-3, 1e-3], (1, 1, 1)), ([1.0, 1.0], (2, 2, 2))]
)
def test_active_dimensions_hold_their_share_of_the_variance(sigmas, expected):
    assert active_dimensions(np.array(sigmas)) == expected
    assert active_dimensions(np.array(sigmas)[::-1].copy()) == expected


class TestReflection:
    def test_mirror_images_join_the_shapes_and_the_record(self, tmp_path):
        module = train_cohort(ellipsoids(3), replace(CONFIG, reflected=True, steps=2), tmp_path)
        _, found = read_record(tmp_path)
        assert len(module.mean) == found["codes"] == len(found["volumes_ml"]) == 6
        assert found["volumes_ml"][:3] == found["volumes_ml"][3:]
        assert len(found["train"]) == 3

    def test_without_it_there_is_one_code_a_shape(self, tmp_path):
        module = train_cohort(ellipsoids(3), replace(CONFIG, steps=2), tmp_path)
        assert len(module.mean) == read_record(tmp_path)[1]["codes"] == 3
