import csv

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.errors import CohortError, InputError, InvalidGeometry, InvalidMask, UnreadableImage
from model.geometry import Grid
from training.cohorts import Case, CohortName, CohortOptions, Provenance, data_folder, load_cohort, read_folder
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

OWN = Provenance("made here", "CC0", "nobody", shippable=True)


def ball(radius=6.0, size=20, centre=None, stretch=(1.0, 1.0, 1.0)):
    centre = np.full(3, (size - 1) / 2) if centre is None else np.asarray(centre)
    index = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1)
    return (((index - centre) / stretch) ** 2).sum(axis=-1) <= radius**2


def case(name, mask, *, split="train", person=None, spacing=1.0):
    affine = np.diag([spacing, spacing, spacing, 1.0])
    return Case(name, person or name, split, mask, Grid(mask.shape, affine))


def balls(count=8, **more):
    return [case(f"c{n}", ball(5.0 + 0.2 * n, centre=(9.5 + 0.05 * n, 9.5, 9.5)), **more) for n in range(count)]


def write(folder, name, mask, affine=None):
    folder.mkdir(parents=True, exist_ok=True)
    image = nib.Nifti1Image(mask.astype(np.uint8), np.eye(4) if affine is None else affine)
    nib.save(image, folder / f"{name}.nii.gz")


def write_table(folder, rows):
    with (folder / "cases.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


def lopsided():
    """A ball with a bump, which no turn or reflection maps onto itself."""
    return ball() | ball(3.0, 20, (15.0, 13.0, 11.0))


def restored(mask, affine, axes, flips):
    """The same voxels at the same places, axes stored in another order and some of them backwards."""
    change = np.zeros((4, 4))
    change[3, 3] = 1.0
    for new, (old, flip) in enumerate(zip(axes, flips, strict=True)):
        change[old, new] = -1.0 if flip else 1.0
        change[old, 3] = mask.shape[old] - 1 if flip else 0.0
    stored = mask.transpose(axes)[tuple(slice(None, None, -1 if flip else 1) for flip in flips)]
    return np.ascontiguousarray(stored), affine @ change


def write_balls(folder, count=6):
    for n in range(count):
        write(folder, f"ball{n}", ball(5.0 + 0.3 * n))


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

    def test_test_cases_stay(self):
        cases = [*balls(), case("t", ball(4.0), split="test")]
        assert hold_out(cases, fraction=0.5, seed=0)[-1].split == "test"

    def test_a_person_in_two_splits_is_refused(self):
        cases = [*balls(), case("t", ball(4.0), split="test", person="c0")]
        with pytest.raises(CohortError, match=r"1 person\(s\) stand in more than one split \(c0\)"):
            assemble("balls", cases, (), OWN, CohortOptions(validation_fraction=0.0))

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


class TestFolder:
    def test_without_a_table_all_train_and_a_fifth_is_held_out(self, tmp_path):
        write_balls(tmp_path, 10)
        cohort = read_folder(tmp_path, CohortOptions())
        assert (len(cohort.train), len(cohort.validation), len(cohort.test)) == (8, 2, 0)
        assert {found.person for found in cohort.cases} == {f"ball{n}" for n in range(10)}

    def test_folders_named_after_splits_are_splits(self, tmp_path):
        for n in range(6):
            write(tmp_path / ("test" if n < 2 else "train"), f"b{n}", ball(5 + 0.3 * n))
        cohort = read_folder(tmp_path, CohortOptions())
        assert {found.name for found in cohort.test} == {"b0", "b1"}

    @pytest.mark.parametrize("deeper", ["sub-{n}", "Train/sub-{n}/anat", ""])
    def test_the_innermost_folder_that_is_named_after_a_split_says_it(self, tmp_path, deeper):
        root = tmp_path / "train" / "cohort"
        for n in range(6):
            folder = deeper.replace("{n}", str(n)) if n > 1 else deeper.replace("{n}", str(n)).replace("Train", "TEST")
            write(root / ("Test" if n < 2 else "TRAIN") / folder, f"b{n}", ball(5 + 0.3 * n))
        cohort = read_folder(root, CohortOptions(validation_fraction=0.0))
        assert {found.name for found in cohort.test} == {"b0", "b1"}
        assert len(cohort.train) == 4

    def test_only_folders_below_the_root_say_a_split(self, tmp_path):
        write_balls(tmp_path / "test" / "cohort")
        cohort = read_folder(tmp_path / "test" / "cohort", CohortOptions())
        assert (len(cohort.train), len(cohort.test)) == (5, 0)

    def test_an_empty_cell_leaves_the_split_to_the_folder(self, tmp_path):
        for n in range(6):
            write(tmp_path / ("test" if n < 2 else "train"), f"b{n}", ball(5 + 0.3 * n))
        write_table(tmp_path, [{"case": f"b{n}", "person": f"p{n}", "split": ""} for n in range(6)])
        assert {found.name for found in read_folder(tmp_path, CohortOptions()).test} == {"b0", "b1"}

    def test_the_table_decides(self, tmp_path):
        write_balls(tmp_path)
        rows = [{"case": f"ball{n}", "subject": f"p{n // 2}", "split": "test" if n < 2 else "train"} for n in range(6)]
        write_table(tmp_path, rows)
        cohort = read_folder(tmp_path, CohortOptions())
        assert {found.name for found in cohort.test} == {"ball0", "ball1"}
        assert len({found.person for found in cohort.cases}) == 3
        assert divided_persons(cohort.cases) == ()

    @pytest.mark.parametrize(
        ("spoil", "reason"),
        [
            (lambda folder: write(folder, "bad", np.zeros((8, 8, 8), bool)), "no foreground"),
            (lambda folder: (folder / "bad.nii.gz").write_bytes(b"\x1f\x8b broken"), "cannot be read"),
            (lambda folder: write(folder, "bad", ball(40.0, 90)), "does not belong to the cohort"),
            (lambda folder: write(folder, "bad", ball(5.5), np.diag([1.0, 1.0, 9.0, 1.0])), "voxel spacing"),
            (lambda folder: write(folder / "again", "ball0", ball(5.1)), "same name"),
        ],
    )
    def test_what_must_not_be_trained_on_is_refused_with_its_reason(self, tmp_path, spoil, reason):
        write_balls(tmp_path)
        spoil(tmp_path)
        with pytest.raises(CohortError, match=reason):
            read_folder(tmp_path, CohortOptions())
        cohort = read_folder(tmp_path, CohortOptions(skip_refused=True))
        assert len(cohort.cases) == 6
        assert reason in cohort.refused[0].reason

    def test_a_listed_case_without_a_file_is_refused(self, tmp_path):
        write_balls(tmp_path)
        write_table(tmp_path, [{"case": "absent", "split": "train"}])
        with pytest.raises(CohortError, match="absent: the table lists it"):
            read_folder(tmp_path, CohortOptions())

    def test_an_unknown_split_is_refused(self, tmp_path):
        write_balls(tmp_path)
        write_table(tmp_path, [{"case": "ball0", "split": "holiday"}])
        with pytest.raises(CohortError, match="unknown split, holiday; train, validation or test"):
            read_folder(tmp_path, CohortOptions())

    @pytest.mark.parametrize("column", ["person", "subject", "patient"])
    @pytest.mark.parametrize("separator", [",", ";", "\t"])
    def test_tables_of_spreadsheets_are_read(self, tmp_path, column, separator):
        write_balls(tmp_path)
        lines = [["Case", column.title(), "SPLIT"], *([f"ball{n}", f"Mü{n // 2}", "Test "] for n in range(2))]
        text = "\r\n".join(separator.join(line) for line in lines) + "\r\n"
        (tmp_path / "cases.csv").write_bytes(text.encode("utf-8-sig"))
        found = read_folder(tmp_path, CohortOptions()).test
        assert [(one.name, one.person) for one in found] == [("ball0", "Mü0"), ("ball1", "Mü0")]

    @pytest.mark.parametrize(
        ("table", "reason"),
        [
            ("case,person\nball0,Müller\n".encode("latin-1"), "UTF-8"),
            (b'case,person\nball0,"open\nball1,p1\n', "cannot be read"),
            (b"case,person\nball0," + 200_000 * b"x" + b"\n", "cannot be read"),
            (b"case,person\nball0,Doe, John\n", "more cells than columns"),
            (b"name,person\nball0,p0\n", "no column case, its columns are name, person"),
            (b"case,split,patient_id\nball0,test,p0\n", "no column person, and patient_id is not read"),
        ],
    )
    def test_a_table_that_would_be_misread_is_refused(self, tmp_path, table, reason):
        write_balls(tmp_path)
        (tmp_path / "cases.csv").write_bytes(table)
        with pytest.raises(CohortError, match=reason):
            read_folder(tmp_path, CohortOptions())

    def test_further_columns_beside_persons_do_no_harm(self, tmp_path):
        write_balls(tmp_path)
        write_table(tmp_path, [{"case": f"ball{n}", "person": f"p{n // 3}", "age": "40"} for n in range(6)])
        assert len({found.person for found in read_folder(tmp_path, CohortOptions()).cases}) == 2

    def test_nothing_at_all_is_refused(self, tmp_path):
        with pytest.raises(CohortError):
            read_folder(tmp_path, CohortOptions(skip_refused=True))
        with pytest.raises(CohortError):
            read_folder(tmp_path / "elsewhere", CohortOptions())

    def test_specks_are_taken_off_training_masks_and_left_on_test_masks(self, tmp_path):
        speckled = ball(5.05)
        speckled[0, 1, 2] = True
        write_balls(tmp_path / "train")
        write(tmp_path / "train", "speckled", speckled)
        write(tmp_path / "test", "other", np.flip(speckled, axis=0) | ball(5.4))
        cohort = read_folder(tmp_path, CohortOptions(validation_fraction=0.0))
        cleaned = next(found for found in cohort.train if found.name == "speckled")
        assert len(part_sizes(cleaned.mask)) == 1
        assert any("1 speck" in text for text in cleaned.findings)
        assert len(part_sizes(cohort.test[0].mask)) == 2


class TestCatalogue:
    def test_adrenal_glands_come_from_the_archive(self, tmp_path):
        (tmp_path / "adrenal").mkdir()
        train = np.stack([ball(5 + 0.2 * n) for n in range(10)]).astype(np.uint8) * 255
        np.savez(
            tmp_path / "adrenal" / "adrenalmnist3d_64.npz",
            train_images=train,
            val_images=np.stack([ball(6.03, stretch=(1, 1, 0.8))]).astype(np.uint8),
        )
        cohort = load_cohort(CohortName.ADRENAL, tmp_path, CohortOptions())
        assert (len(cohort.train), len(cohort.validation), len(cohort.test)) == (8, 2, 1)
        assert cohort.licence == "CC BY 4.0"

    def test_of_the_vertebrae_only_verse_ships(self, tmp_path):
        folder = tmp_path / "vertebra"
        rows = []
        for n in range(8):
            write(folder / "train", f"v{n}", ball(5 + 0.2 * n))
            rows.append(
                {"case": f"v{n}", "subject": f"s{n}", "split": "train", "source": "verse" if n % 2 else "lumase"}
            )
        write_table(folder, rows)
        every = load_cohort(CohortName.VERTEBRA, tmp_path, CohortOptions())
        shipped = load_cohort(CohortName.VERTEBRA, tmp_path, CohortOptions(shippable_only=True))
        assert len(every.cases) == 8
        assert not every.provenance.shippable
        assert {found.name for found in shipped.cases} == {"v1", "v3", "v5", "v7"}
        assert shipped.provenance.shippable

    def test_femurs_never_ship(self, tmp_path):
        with pytest.raises(CohortError, match="must not be shipped"):
            load_cohort(CohortName.FEMUR, tmp_path, CohortOptions(shippable_only=True))

    @pytest.mark.parametrize("name", list(CohortName))
    def test_a_cohort_that_is_not_there_says_so(self, tmp_path, name):
        with pytest.raises(CohortError, match="--data"):
            load_cohort(name, tmp_path, CohortOptions())

    def test_the_data_folder_must_be_there(self, tmp_path):
        assert data_folder(tmp_path) == tmp_path
        with pytest.raises(CohortError, match="MORPHOFLOW_DATA"):
            data_folder(tmp_path / "none")
