"""Layouts in which data sets are published, and alignment."""

import json
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from model.errors import CohortError, InvalidParameter
from model.geometry import Grid
from tests.cohort_parts import ball, opened, save
from training.cohorts import Case, CohortName, CohortOptions
from training.cohorts.alignment import align
from training.cohorts.assemble import assemble
from training.cohorts.cohort import Provenance, SideName
from training.cohorts.sources import LayoutName
from training.cohorts.verse import split_of
from training.cohorts.voxelising import SpaceName
from training.seen import short_digest


class TestSource:
    @pytest.mark.parametrize(
        "source",
        [{}, {"cohort": CohortName.TALUS, "masks": Path()}, {"masks": Path(), "meshes": Path()}],
    )
    def test_exactly_one_source_is_taken(self, source):
        with pytest.raises(InvalidParameter, match="exactly one"):
            opened(**source)

    def test_a_layout_belongs_to_masks(self, tmp_path):
        with pytest.raises(InvalidParameter, match="--layout goes with --masks"):
            opened(meshes=tmp_path, layout=LayoutName.VERSE)

    @pytest.mark.parametrize(
        ("source", "option"),
        [
            ({"meshes": Path(), "labels": (3,)}, "--label"),
            ({"masks": Path(), "layout": LayoutName.MEDMNIST, "labels": (3,)}, "--label"),
            ({"cohort": CohortName.TALUS, "labels": (3,)}, "--label"),
            ({"masks": Path(), "spacing_mm": 2.0}, "--spacing-mm"),
            ({"cohort": CohortName.TALUS, "spacing_mm": 2.0}, "--spacing-mm"),
            ({"masks": Path(), "space": SpaceName.LPS}, "--mesh-space"),
            ({"masks": Path(), "layout": LayoutName.MEDMNIST, "space": SpaceName.LPS}, "--mesh-space"),
            ({"masks": Path(), "data": Path()}, "--data"),
            ({"cohort": CohortName.TALUS, "side": SideName.LEFT}, "--side"),
        ],
    )
    def test_an_option_that_would_do_nothing_is_refused(self, source, option):
        with pytest.raises(InvalidParameter, match=f"{option} would do nothing here; {option} goes with"):
            opened(**source)

    def test_the_side_is_not_stated_until_a_caller_says_it(self, tmp_path):
        for n in range(3):
            save(tmp_path / f"b{n}.nii.gz", ball(5.0 + 0.2 * n))
        assert opened(masks=tmp_path).side == "not stated"
        assert not opened(masks=tmp_path).reflects
        for side in SideName:
            assert opened(masks=tmp_path, side=side).side == side

    def test_test_persons_are_held_out_where_there_are_none(self, tmp_path):
        for n in range(10):
            save(tmp_path / f"b{n}.nii.gz", ball(5.0 + 0.2 * n))
        found = opened(CohortOptions(test_fraction=0.3), masks=tmp_path)
        assert (len(found.test), len(found.validation), len(found.train)) == (3, 1, 6)


class TestDecathlon:
    def write(self, root, listed=True):
        names = [f"hippocampus_{n:03d}.nii.gz" for n in range(4)]
        for n, name in enumerate(names):
            save(root / "labelsTr" / name, ball(5.0 + 0.3 * n) * (1 + (n % 2)))
        facts = {"name": "Hippocampus", "licence": "CC-BY-SA 4.0", "labels": {"0": "background", "1": "Anterior"}}
        pairs = [{"image": f"./imagesTr/{name}", "label": f"./labelsTr/{name}"} for name in names]
        (root / "dataset.json").write_text(json.dumps(facts | ({"training": pairs} if listed else {})))

    @pytest.mark.parametrize("listed", [True, False])
    def test_cases_licence_and_name_come_from_the_description(self, tmp_path, listed):
        self.write(tmp_path, listed)
        found = opened(masks=tmp_path, layout=LayoutName.DECATHLON)
        assert [case.name for case in found.train] == [f"hippocampus_{n:03d}" for n in range(4)]
        assert (found.name, found.licence) == ("hippocampus", "CC-BY-SA 4.0")

    def test_labelled_test_cases_are_the_test_split(self, tmp_path):
        self.write(tmp_path)
        save(tmp_path / "labelsTs" / "hippocampus_900.nii.gz", ball(5.5))
        assert [case.name for case in opened(masks=tmp_path, layout=LayoutName.DECATHLON).test] == ["hippocampus_900"]

    @pytest.mark.parametrize("split", [{}, {"split": ""}])
    def test_a_table_of_persons_leaves_the_test_cases_where_they_are(self, tmp_path, split):
        self.write(tmp_path)
        save(tmp_path / "labelsTs" / "hippocampus_900.nii.gz", ball(5.5))
        rows = [{"case": f"hippocampus_{n:03d}", "person": f"p{n // 2}", **split} for n in (0, 1, 2, 3, 900)]
        lines = [",".join(rows[0]), *(",".join(row.values()) for row in rows)]
        (tmp_path / "cases.csv").write_text("\n".join(lines))
        found = opened(masks=tmp_path, layout=LayoutName.DECATHLON)
        assert [(case.name, case.person) for case in found.test] == [("hippocampus_900", "p450")]
        assert len({case.person for case in found.train}) == 2

    def test_a_table_may_say_another_split(self, tmp_path):
        self.write(tmp_path)
        save(tmp_path / "labelsTs" / "hippocampus_900.nii.gz", ball(5.5))
        (tmp_path / "cases.csv").write_text("case,split\nhippocampus_900,train\nhippocampus_000,test\n")
        assert [case.name for case in opened(masks=tmp_path, layout=LayoutName.DECATHLON).test] == ["hippocampus_000"]

    def test_a_row_of_no_file_is_refused(self, tmp_path):
        self.write(tmp_path)
        (tmp_path / "cases.csv").write_text("case,split\nhippocampus_000.nii.gz,test\n")
        with pytest.raises(CohortError, match=r"hippocampus_000.nii.gz: .*its file is missing; .*without their suffix"):
            opened(masks=tmp_path, layout=LayoutName.DECATHLON)

    def test_a_label_that_is_missing_is_named(self, tmp_path):
        self.write(tmp_path)
        (tmp_path / "labelsTr" / "hippocampus_002.nii.gz").unlink()
        with pytest.raises(CohortError, match=r"hippocampus_002: .*its label is missing"):
            opened(masks=tmp_path, layout=LayoutName.DECATHLON)

    def test_a_folder_without_a_description_is_refused(self, tmp_path):
        with pytest.raises(CohortError, match=r"dataset.json"):
            opened(masks=tmp_path, layout=LayoutName.DECATHLON)


class TestMedMnist:
    def test_splits_are_those_of_the_file(self, tmp_path):
        images = np.stack([ball(5.0 + 0.3 * n) for n in range(8)]).astype(np.uint8)
        np.savez(
            tmp_path / "vesselmnist3d.npz", train_images=images[:5], val_images=images[5:7], test_images=images[7:]
        )
        found = opened(masks=tmp_path / "vesselmnist3d.npz", layout=LayoutName.MEDMNIST, spacing_mm=2.0)
        assert (found.name, len(found.train), len(found.validation), len(found.test)) == ("vesselmnist3d", 5, 2, 1)
        assert found.train[0].grid.spacing == pytest.approx([2.0, 2.0, 2.0])

    def test_grey_values_are_refused(self, tmp_path):
        np.savez(tmp_path / "organ.npz", train_images=np.random.default_rng(0).integers(0, 255, (3, 9, 9, 9)))
        with pytest.raises(CohortError, match="other values than 0 and one"):
            opened(masks=tmp_path / "organ.npz", layout=LayoutName.MEDMNIST)

    @pytest.mark.parametrize("value", [2, -1, np.nan])
    def test_another_value_in_any_image_is_refused(self, tmp_path, value):
        images = np.stack([ball(5.0 + 0.1 * n) for n in range(20)]).astype(float)
        images[18, 0, 0, 0] = value
        np.savez(tmp_path / "vessel.npz", train_images=images)
        with pytest.raises(CohortError, match="other values than 0 and one"):
            opened(masks=tmp_path / "vessel.npz", layout=LayoutName.MEDMNIST)

    @pytest.mark.parametrize("spacing_mm", [-1.0, 0.0, np.nan])
    def test_a_voxel_size_that_none_has_is_refused(self, tmp_path, spacing_mm):
        np.savez(tmp_path / "vessel.npz", train_images=np.stack([ball(5.0), ball(6.0)]))
        with pytest.raises(InvalidParameter, match=r"spacing_mm .* 0.05 to 20 mm is accepted"):
            opened(masks=tmp_path / "vessel.npz", layout=LayoutName.MEDMNIST, spacing_mm=spacing_mm)

    def test_other_files_are_refused(self, tmp_path):
        (tmp_path / "no.npz").write_bytes(b"PK")
        with pytest.raises(CohortError, match="NPZ"):
            opened(masks=tmp_path / "no.npz", layout=LayoutName.MEDMNIST)


class TestVerse:
    """Small scans of stacked ellipsoids in the layout by subject."""

    AFFINE = np.array([[0, 0, -1.5, 40.0], [-1.0, 0, 0, 20.0], [0, 1.0, 0, -100.0], [0, 0, 0, 1.0]])

    def scan(self, top=24, count=4, radius=5.5):
        labels = np.zeros((26, 16 * count + 4, 20), np.uint8)
        index = np.stack(np.meshgrid(*map(np.arange, labels.shape), indexing="ij"), axis=-1)
        middles = {}
        for n in range(count):
            middle = np.array([12.0, 9.0 + 16 * n, 9.0])
            labels[(((index - middle) / [1.2 + 0.08 * n, 1.0, 1.2]) ** 2).sum(axis=-1) <= radius**2] = top - n
            middles[top - n] = middle
        return labels, middles

    def write(self, root, subject, split="training", entity="", direction=None, skip=(), radius=5.5, change=None):
        labels, middles = self.scan(radius=radius)
        labels = labels if change is None else change(labels)
        folder = root / f"dataset-{split}" / "derivatives" / f"sub-{subject}"
        name = f"sub-{subject}{entity}"
        save(folder / f"{name}_seg-vert_msk.nii.gz", labels, self.AFFINE)
        entries = [{"direction": list(direction)}] if direction else []
        for label, middle in middles.items():
            if label not in skip:
                place = middle if direction is None else self.along(middle, direction, labels.shape)
                entries.append({"label": label, **dict(zip("XYZ", place.tolist(), strict=True))})
        (folder / f"{name}_seg-subreg_ctd.json").write_text(json.dumps(entries))

    def along(self, middle, direction, shape):
        """A place of the image, whose axes are P, S, L, along other axes."""
        image = "PSL"
        opposite = dict(zip("RLAPIS", "LRPASI", strict=True))
        found = []
        for letter in direction:
            axis = image.index(letter) if letter in image else image.index(opposite[letter])
            found.append(middle[axis] if letter in image else shape[axis] - 1 - middle[axis])
        return np.array(found)

    def test_vertebrae_are_cut_out_by_person_and_split(self, tmp_path):
        for n in range(3):
            self.write(tmp_path, f"verse{n:03d}", radius=5.2 + 0.2 * n)
        self.write(tmp_path, "verse000", entity="_split-verse260", radius=5.05)
        self.write(tmp_path, "verse500", split="test", radius=5.95)
        found = opened(masks=tmp_path, layout=LayoutName.VERSE)
        assert len(found.train) == 16
        assert {case.person for case in found.train} == {"sub-verse000", "sub-verse001", "sub-verse002"}
        assert [case.name for case in found.test] == [f"sub-verse500_L{n}" for n in (2, 3, 4, 5)]
        case = found.test[3]
        world = case.grid.to_world(np.argwhere(case.mask).astype(float)).mean(axis=0)
        assert world == pytest.approx((self.AFFINE @ [12.0, 9.0, 9.0, 1.0])[:3], abs=0.05)
        assert found.provenance.shippable

    @pytest.mark.parametrize(
        ("root", "below", "split"),
        [
            ("latest-verse", "derivatives", "train"),
            ("test", "latest/derivatives", "train"),
            ("verse", "dataset-verse19test/derivatives", "test"),
            ("verse", "dataset-03test/derivatives", "test"),
            ("verse", "dataset-02Validation/derivatives", "validation"),
            ("verse", "test/latest/derivatives", "test"),
            ("test", "dataset-01training/derivatives", "train"),
        ],
    )
    def test_whole_words_below_the_root_say_the_split(self, root, below, split):
        assert split_of(Path(root) / below / "sub-verse004" / "mask.nii.gz", Path(root)) == split

    @pytest.mark.parametrize("direction", ["PSL", "ASR", "LPS", "RAI"])
    def test_centroids_are_understood_along_any_axes(self, tmp_path, direction):
        for n in range(2):
            self.write(tmp_path, f"verse{n:03d}", direction=direction, radius=5.2 + 0.2 * n)
        assert len(opened(masks=tmp_path, layout=LayoutName.VERSE, labels=(22, 23)).train) == 4

    def test_partial_vertebrae_are_left_out_with_their_reason(self, tmp_path):
        self.write(tmp_path, "verse000", skip=(22,))
        self.write(tmp_path, "verse001", radius=5.3, change=lambda labels: labels[:, 6:])
        self.write(tmp_path, "verse002", radius=5.1)
        reasons = {one.name: one.reason for one in opened(masks=tmp_path, layout=LayoutName.VERSE).refused}
        assert "no centroid" in reasons["sub-verse000_L3"]
        assert "border of the scan" in reasons["sub-verse001_L5"]

    def test_centroids_of_another_scan_stop(self, tmp_path):
        self.write(tmp_path, "verse000")
        (entry,) = (tmp_path / "dataset-training" / "derivatives" / "sub-verse000").glob("*.json")
        entry.write_text(json.dumps([{"label": 24, "X": 1.0, "Y": 60.0, "Z": 1.0}]))
        with pytest.raises(CohortError, match="sub-verse000_L5: its centroid lies outside"):
            opened(masks=tmp_path, layout=LayoutName.VERSE, labels=(24,))

    def test_a_scan_without_centroids_is_named(self, tmp_path):
        self.write(tmp_path, "verse000")
        self.write(tmp_path, "verse001", radius=5.2)
        (entry,) = (tmp_path / "dataset-training" / "derivatives" / "sub-verse001").glob("*.json")
        entry.unlink()
        with pytest.raises(CohortError, match=r"sub-verse001: .*centroids"):
            opened(masks=tmp_path, layout=LayoutName.VERSE)

    def test_other_folders_and_labels_are_refused(self, tmp_path):
        with pytest.raises(CohortError, match="VerSe by subject"):
            opened(masks=tmp_path, layout=LayoutName.VERSE)
        with pytest.raises(CohortError, match="Label 26 is no vertebra"):
            opened(masks=tmp_path, layout=LayoutName.VERSE, labels=(26,))


class TestOaiZib:
    def write(self, root, participant, radius, suffix=".segmentation_masks.mhd"):
        folder = root / "segmentation" / "segmentation_masks"
        folder.mkdir(parents=True, exist_ok=True)
        values = np.zeros((20, 24, 20), np.uint8)
        values[:, :20][ball(radius)] = 1
        values[:, 21] = 3
        image = sitk.GetImageFromArray(values)
        image.SetSpacing([0.36, 0.36, 0.7])
        sitk.WriteImage(image, str(folder / f"{participant}{suffix}"), useCompression=True)

    def test_the_femoral_bone_is_cut_out_and_knees_of_one_person_stay_together(self, tmp_path):
        for n in range(5):
            self.write(tmp_path, f"90011{n:02d}", 5.0 + 0.2 * n)
        self.write(tmp_path, "9001100", 6.1, suffix="_V01.mhd")
        self.write(tmp_path, "9001107", 6.4, suffix=".nii.gz")
        found = opened(CohortOptions(), masks=tmp_path, layout=LayoutName.OAI_ZIB)
        everything = {case.name: case for case in found.cases}
        assert len(everything) == 7
        assert found.side == "mixed"
        assert everything["9001100.segmentation_masks"].person == everything["9001100_V01"].person == "9001100"
        assert int(everything["9001101.segmentation_masks"].mask.sum()) == int(ball(5.2).sum())
        assert sorted(everything["9001101.segmentation_masks"].grid.spacing) == pytest.approx([0.36, 0.36, 0.7])

    def test_a_row_of_no_knee_is_refused_and_files_of_other_names_are_told(self, tmp_path):
        for n in range(3):
            self.write(tmp_path, f"90011{n:02d}", 5.0 + 0.2 * n)
        self.write(tmp_path, "knee", 5.5)
        found = opened(CohortOptions(), masks=tmp_path, layout=LayoutName.OAI_ZIB)
        assert [(one.name, one.stops) for one in found.refused] == [("knee.segmentation_masks.mhd", False)]
        (tmp_path / "cases.csv").write_text("case,split\n9001101,test\n9001102.segmentation_masks.mhd,test\n")
        with pytest.raises(CohortError, match=r"9001102.segmentation_masks.mhd: .*its file is missing"):
            opened(CohortOptions(), masks=tmp_path, layout=LayoutName.OAI_ZIB)

    def test_a_folder_of_other_masks_is_refused(self, tmp_path):
        save(tmp_path / "femur.nii.gz", ball())
        with pytest.raises(CohortError, match="seven digits"):
            opened(masks=tmp_path, layout=LayoutName.OAI_ZIB)


class TestAlignment:
    """An L of two unequal bars has no rotation that maps it onto itself."""

    def bars(self, turn, rng):
        size = 48
        index = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1) - (size - 1) / 2
        local = index @ turn + rng.uniform(-2.0, 2.0, 3)
        long = (np.abs(local - [0.0, 0.0, 0.0]) <= [4.0, 5.0, 15.0]).all(axis=-1)
        short = (np.abs(local - [8.0, 0.0, -11.0]) <= [6.0, 3.0 + rng.uniform(0, 0.5), 4.0]).all(axis=-1)
        return long | short

    def spread(self, cases, turns):
        relative = [Rotation.from_matrix(case.grid.directions @ turn) for case, turn in zip(cases, turns, strict=True)]
        return [(relative[0].inv() * one).magnitude() for one in relative[1:]]

    @pytest.mark.parametrize("reach", [0.35, 1.4])
    def test_turned_copies_end_up_alike_and_no_voxel_changes(self, reach):
        rng = np.random.default_rng(3)
        turns = [Rotation.from_rotvec(reach * rng.uniform(-1, 1, 3)).as_matrix() for _ in range(6)]
        grid = Grid((48, 48, 48), np.eye(4))
        cases = [Case(f"l{n}", f"l{n}", "train", self.bars(turn, rng), grid) for n, turn in enumerate(turns)]
        cohort = assemble("l", cases, (), Provenance("made here", "CC0", "", shippable=True), CohortOptions())
        told = []
        found = align(cohort, lambda done, total: told.append((done, total)))
        steps = 3 * len(cohort.train) + len(cohort.validation)
        assert told == [(n, steps) for n in range(1, steps + 1)]
        before = {case.name: case for case in cohort.cases}
        after = {case.name: case for case in found.cases}
        names = sorted(after)
        assert max(self.spread([before[name] for name in names], turns)) > 0.3
        assert max(self.spread([after[name] for name in names], turns)) < np.deg2rad(3.0)
        for name in names:
            assert np.array_equal(before[name].mask, after[name].mask)
            assert short_digest(before[name]) == short_digest(after[name])
            assert after[name].grid.spacing == pytest.approx([1.0, 1.0, 1.0])

    @pytest.mark.parametrize("thickness", [1, 2])
    def test_sheets_thinner_than_the_voxels_of_the_mean_are_aligned(self, thickness):
        rows, columns = np.mgrid[-45:45, -40:40]
        cases = []
        for n in range(4):
            mask = np.zeros((90, 80, 8), bool)
            mask[:, :, 3 : 3 + thickness] = ((rows / (30 + n)) ** 2 + (columns / (24 + n)) ** 2 <= 1.0)[:, :, None]
            cases.append(Case(f"s{n}", f"s{n}", "train", mask, Grid(mask.shape, np.eye(4))))
        cohort = assemble("sheets", cases, (), Provenance("made here", "CC0", "", shippable=True), CohortOptions())
        for case in align(cohort).cases:
            assert np.isfinite(case.grid.affine).all()
            assert np.degrees(np.arccos(np.clip(case.grid.directions[2, 2], -1.0, 1.0))) < 10.0

    def test_an_object_of_two_voxels_is_aligned(self):
        masks = np.zeros((3, 9, 9, 9), bool)
        masks[:, 4, 4, 4] = masks[0, 5, 4, 4] = masks[1, 4, 5, 4] = masks[2, 4, 4, 5] = True
        cases = [Case(f"v{n}", f"v{n}", "train", mask, Grid(mask.shape, np.eye(4))) for n, mask in enumerate(masks)]
        cohort = assemble("voxels", cases, (), Provenance("made here", "CC0", "", shippable=True), CohortOptions())
        assert all(np.isfinite(case.grid.affine).all() for case in align(cohort).cases)
