"""Reading, division and inspection of cohorts."""

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.errors import CohortError, InputError, InvalidGeometry, InvalidMask, UnreadableImage
from model.geometry import Grid
from tests.cohort_parts import OWN, ball, balls, case, lopsided, restored, write
from training.cohorts import Case, CohortOptions
from training.cohorts.assemble import assemble
from training.cohorts.cohort import divided_persons, hold_out
from training.cohorts.inspect import (
    copies,
    findings_of,
    outliers,
    part_sizes,
    shape_digest,
    touches_border,
    without_specks,
)
from training.cohorts.reading import read_mask


class TestReading:
    @pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".nrrd", ".mha", ".mhd"])
    def test_every_format_puts_voxels_at_the_same_place_in_the_world(self, tmp_path, suffix):
        values = np.zeros((4, 5, 6), np.uint8)
        values[1, 2, 3], values[2, 0, 5] = 1, 2
        affine = np.eye(4)
        affine[:3, :3] = Rotation.from_rotvec([0.2, -0.3, 0.5]).as_matrix() * [0.7, 1.1, 2.5]
        affine[:3, 3] = [-30.0, 12.0, 7.0]
        path = tmp_path / f"mask{suffix}"
        if suffix.startswith(".nii"):
            nib.save(nib.Nifti1Image(values, affine), path)
        else:
            lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
            image = sitk.GetImageFromArray(values.T)
            image.SetSpacing(np.linalg.norm(lps[:3, :3], axis=0).tolist())
            image.SetDirection((lps[:3, :3] / np.linalg.norm(lps[:3, :3], axis=0)).ravel().tolist())
            image.SetOrigin(lps[:3, 3].tolist())
            sitk.WriteImage(image, str(path))
        found = read_mask(path)
        assert np.array_equal(found.mask, values > 0)
        assert np.allclose(found.grid.affine, affine, atol=1e-4)
        assert np.array_equal(read_mask(path, [2]).mask, values == 2)

    def test_a_file_that_ends_too_early_is_unreadable(self, tmp_path):
        write(tmp_path, "whole", ball())
        cut = tmp_path / "cut.nii.gz"
        cut.write_bytes((tmp_path / "whole.nii.gz").read_bytes()[:-40])
        with pytest.raises(UnreadableImage):
            read_mask(cut)

    @pytest.mark.parametrize("suffix", [".nii.gz", ".nii", ".nrrd", ".mha"])
    def test_other_bytes_are_unreadable(self, tmp_path, suffix):
        path = tmp_path / f"noise{suffix}"
        path.write_bytes(b"this is no image at all" * 30)
        with pytest.raises(UnreadableImage):
            read_mask(path)

    def test_a_sheared_grid_is_refused(self, tmp_path):
        affine = np.eye(4)
        affine[0, 1] = 0.3
        write(tmp_path, "sheared", ball(), affine)
        with pytest.raises(InvalidGeometry):
            read_mask(tmp_path / "sheared.nii.gz")

    def test_grey_values_are_no_mask(self, tmp_path):
        nib.save(nib.Nifti1Image(np.random.default_rng(0).normal(size=(6, 6, 6)), np.eye(4)), tmp_path / "grey.nii")
        with pytest.raises(InvalidMask):
            read_mask(tmp_path / "grey.nii")

    def test_messages_hold_no_path(self, tmp_path):
        (tmp_path / "secret.nii.gz").write_bytes(b"nothing")
        with pytest.raises(InputError) as caught:
            read_mask(tmp_path / "secret.nii.gz")
        assert "secret" not in str(caught.value)
        assert str(tmp_path) not in str(caught.value)


class TestSplits:
    @given(
        persons=st.lists(st.integers(0, 12), min_size=1, max_size=40),
        fraction=st.floats(0.05, 0.9),
        seed=st.integers(0, 5),
    )
    def test_persons_are_never_divided(self, persons, fraction, seed):
        cases = [case(f"c{n}", ball(1.0, 3), person=f"p{person}") for n, person in enumerate(persons)]
        held = hold_out(cases, fraction=fraction, seed=seed)
        assert divided_persons(held) == ()
        assert [found.name for found in held] == [found.name for found in cases]
        everyone = len(set(persons))
        chosen = len({found.person for found in held if found.split == "validation"})
        assert chosen == (0 if everyone < 2 else min(max(1, round(fraction * everyone)), everyone - 1))

    @given(seed=st.integers(0, 50), order=st.permutations(range(8)))
    def test_the_order_of_cases_does_not_matter(self, seed, order):
        cases = balls()
        one = {found.name: found.split for found in hold_out(cases, fraction=0.3, seed=seed)}
        other = {found.name: found.split for found in hold_out([cases[n] for n in order], fraction=0.3, seed=seed)}
        assert one == other

    @given(seed=st.integers(0, 20), count=st.integers(5, 30))
    def test_what_was_held_out_for_validation_is_not_what_a_test_split_holds_out_later(self, seed, count):
        cases = [case(f"c{n}", ball(1.0, 3)) for n in range(count)]
        validated = {one.name for one in hold_out(cases, fraction=0.2, seed=seed) if one.split == "validation"}
        tested = {one.name for one in hold_out(cases, fraction=0.2, seed=seed, split="test") if one.split == "test"}
        assert validated
        assert tested
        assert not validated & tested

    def test_test_cases_stay(self):
        cases = [*balls(), case("t", ball(4.0), split="test")]
        assert hold_out(cases, fraction=0.5, seed=0)[-1].split == "test"

    def test_a_person_in_two_splits_is_refused(self):
        cases = [*balls(), case("t", ball(4.0), split="test", person="c0")]
        with pytest.raises(CohortError, match=r"1 person\(s\) stand in more than one split \(c0\)"):
            assemble("balls", cases, (), OWN, CohortOptions(validation_fraction=0.0))

    @pytest.mark.parametrize("factor", [0.001, 1000.0])
    def test_masks_in_another_unit_than_mm_are_refused_by_name(self, factor):
        cases = [case(f"u{n}", ball(4.0 + 0.3 * n), spacing=factor) for n in range(3)]
        with pytest.raises(CohortError, match=r"u0: the object is .* mm long; 2 to 2000 mm is accepted.*given in mm\?"):
            assemble("balls", [*cases, *balls()], (), OWN, CohortOptions())
        kept = assemble("balls", [*cases, *balls()], (), OWN, CohortOptions(skip_refused=True))
        assert not {found.name for found in kept.cases} & {found.name for found in cases}

    def test_where_nothing_is_left_to_train_on_the_other_splits_are_counted(self):
        cases = [case(f"t{n}", ball(4.0 + 0.3 * n), split="test") for n in range(3)]
        with pytest.raises(CohortError, match=r"left to train on \(0 train, 0 validation, 3 test\)$"):
            assemble("balls", cases, (), OWN, CohortOptions())
        with pytest.raises(CohortError, match="NIfTI, NRRD or MetaImage is accepted"):
            assemble("balls", (), (), OWN, CohortOptions())


class TestInspection:
    @given(places=st.sets(st.tuples(*[st.sampled_from([0, 2, 17, 19])] * 3), max_size=5))
    def test_specks_are_counted_and_removed(self, places):
        mask = ball()
        for place in places:
            mask[place] = True
        cleaned = without_specks(mask)
        assert np.array_equal(cleaned, ball())
        assert np.array_equal(without_specks(cleaned), cleaned)
        assert len(part_sizes(mask)) == 1 + len(places)
        said = [text for text in findings_of(mask) if "speck" in text]
        assert said == (
            [f"{len(places)} speck(s) apart from the main part, {len(places)} voxel(s) in all"] if places else []
        )

    def test_a_second_large_part_stays(self):
        mask = ball(3.0, 20, (5, 5, 5)) | ball(3.0, 20, (14, 14, 14))
        assert np.array_equal(without_specks(mask), mask)
        assert any("2 large parts" in text for text in findings_of(mask))

    @pytest.mark.parametrize("axis", [0, 1, 2])
    @pytest.mark.parametrize("end", [0, -1])
    def test_each_face_of_the_crop_is_noticed(self, axis, end):
        mask = ball()
        assert not touches_border(mask)
        np.moveaxis(mask, axis, 0)[end, 10, 10] = True
        assert touches_border(mask)

    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_repeated_slices_are_noticed_along_their_axis(self, axis):
        thick = np.repeat(ball(), 2, axis=axis)
        assert any(f"along axis {axis} are equal" in text for text in findings_of(thick))
        assert not any("equal" in text for text in findings_of(ball()))

    def test_a_copy_is_found_wherever_it_lies_and_the_test_case_is_kept(self):
        moved = case("moved", np.roll(ball(), 2, axis=1), split="test")
        found = copies([case("first", ball()), *balls(4), moved])
        assert [(refusal.name, refusal.stops) for refusal in found] == [("first", False)]
        assert "moved" in found[0].reason

    @given(
        axes=st.permutations(range(3)),
        flips=st.tuples(*[st.booleans()] * 3),
        turn=st.tuples(*[st.floats(-0.25, 0.25)] * 3),
        spacing=st.tuples(*[st.sampled_from([0.3125, 0.390625, 0.6667, 0.7, 0.78125, 0.9765625, 1.0])] * 3),
    )
    def test_a_digest_does_not_depend_on_how_the_axes_are_stored(self, axes, flips, turn, spacing):
        mask, affine = lopsided(), np.diag([*spacing, 1.0])
        affine[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ affine[:3, :3]
        stored, moved = restored(mask, affine, axes, flips)
        digest = shape_digest(mask, Grid(mask.shape, affine))
        rounded = moved.astype(np.float32).astype(float)
        assert shape_digest(stored, Grid(stored.shape, rounded)) == digest

    def test_stored_otherwise_a_mask_is_a_copy_and_mirrored_or_of_another_size_it_is_none(self):
        mask, affine = lopsided(), np.eye(4)
        stored, moved = restored(mask, affine, (2, 0, 1), (True, True, False))
        mirrored = np.diag([-1.0, 1.0, 1.0, 1.0])
        cases = [
            Case("one", "one", "train", mask, Grid(mask.shape, affine)),
            Case("again", "again", "train", stored, Grid(stored.shape, moved)),
            Case("mirrored", "mirrored", "train", mask, Grid(mask.shape, mirrored)),
            case("larger", mask, spacing=1.5),
        ]
        assert [refusal.name for refusal in copies(cases)] == ["again"]

    @given(factor=st.floats(0.2, 5.0))
    def test_outliers_do_not_depend_on_the_unit(self, factor):
        strange = case("strange", ball(9.0), spacing=4.0 * factor)
        ordinary = [case(f"c{n}", ball(5.0 + 0.2 * n), spacing=factor) for n in range(8)]
        assert [refusal.name for refusal in outliers([*ordinary, strange])] == ["strange"]
        assert outliers(ordinary) == ()

    def test_the_reason_is_in_words(self):
        (refusal,) = outliers([*balls(), case("large", ball(40.0, 90))])
        assert refusal.name == "large"
        assert "volume" in refusal.reason
        assert "mL" in refusal.reason
        assert "extent" in refusal.reason

    def test_natural_variation_of_a_factor_of_two_stays(self):
        cases = [case(f"c{n}", ball(radius)) for n, radius in enumerate(np.linspace(5.0, 6.25, 9))]
        assert outliers(cases) == ()
