"""Folders of masks with their tables, and the public cohorts."""

import numpy as np
import pytest

from model.errors import CohortError
from tests.cohort_parts import ball, write, write_balls, write_table
from training.cohorts import CohortName, CohortOptions, data_folder, load_cohort, read_folder
from training.cohorts.cohort import divided_persons
from training.cohorts.inspect import (
    part_sizes,
)


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

    @pytest.mark.parametrize(("train", "held", "test"), [("Training", "val", "Testing"), ("train", "valid", "test")])
    def test_other_usual_names_are_splits_too(self, tmp_path, train, held, test):
        for n, name in enumerate((train, train, train, held, test)):
            write(tmp_path / name, f"b{n}", ball(5 + 0.3 * n))
        cohort = read_folder(tmp_path, CohortOptions())
        assert [case.name for case in (*cohort.validation, *cohort.test)] == ["b3", "b4"]
        write_table(tmp_path, [{"case": f"b{n}", "person": f"p{n}", "split": held} for n in (0, 3, 4)])
        assert len(read_folder(tmp_path, CohortOptions()).validation) == 3

    @pytest.mark.parametrize("name", ["Cases.csv", "cases.tsv", "train/cases.csv"])
    def test_a_table_that_is_not_read_is_refused(self, tmp_path, name):
        write_balls(tmp_path / "train")
        (tmp_path / name).write_text("case,person\nball0,p\nball1,p\n")
        with pytest.raises(CohortError, match=f"holds {name}, which is not read"):
            read_folder(tmp_path, CohortOptions())

    def test_images_of_other_formats_are_told(self, tmp_path):
        write_balls(tmp_path)
        for name in ("a.mgz", "b.dcm", "readme.txt", ".hidden.mgz"):
            (tmp_path / name).write_bytes(b"")
        assert [one.name for one in read_folder(tmp_path, CohortOptions()).refused] == ["a.mgz", "b.dcm"]

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
        with pytest.raises(CohortError, match=r"does not exist.*MORPHOFLOW_DATA"):
            data_folder(tmp_path / "none")

    def test_the_data_folder_is_named_by_the_caller_or_the_environment(self, tmp_path, monkeypatch):
        for folder in ("work", "shared/data", "elsewhere"):
            (tmp_path / folder).mkdir(parents=True)
        monkeypatch.chdir(tmp_path / "work")
        monkeypatch.delenv("MORPHOFLOW_DATA", raising=False)
        with pytest.raises(CohortError, match="none is named; name one with --data or MORPHOFLOW_DATA"):
            data_folder(None)
        monkeypatch.setenv("MORPHOFLOW_DATA", str(tmp_path / "elsewhere"))
        assert data_folder(None) == tmp_path / "elsewhere"
        assert data_folder(tmp_path / "shared") == tmp_path / "shared"
