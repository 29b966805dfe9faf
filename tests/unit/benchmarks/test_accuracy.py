import io
import math
from concurrent.futures import ProcessPoolExecutor
from csv import DictReader
from multiprocessing import get_context

import numpy as np
import pytest

from benchmarks.accuracy.cells import Cell, CellFile, CellKey
from benchmarks.accuracy.drawings import DrawingName, draw
from benchmarks.accuracy.measuring import Task, measure, measure_all
from benchmarks.accuracy.memory import with_peak
from benchmarks.accuracy.methods import Filled, Sources, make_fill
from benchmarks.accuracy.names import MethodName, reason_against
from benchmarks.accuracy.page import BEGIN, END, with_generated
from benchmarks.accuracy.pictures import best_median_worst, contours, surface_error, truth_surface
from benchmarks.accuracy.plan import CohortPlan, keys_of, tasks_of, without
from benchmarks.accuracy.summary import row_of, summarise, write_csv
from benchmarks.accuracy.table import as_markdown
from benchmarks.accuracy.targets import Target, targets_of
from model.geometry import Grid
from tests.analytic_shapes import Ellipsoid
from training.cohorts import Case

GRID = Grid((40, 36, 44), np.diag([1.0, 1.0, 1.0, 1.0]))
THIN, ORTHOGONAL = DrawingName.THIN, DrawingName.ORTHOGONAL


def ellipsoid_case(name="a", semi_axes=(13.0, 11.0, 17.0)):
    return Case(name, name, "test", Ellipsoid(semi_axes, np.array([19.6, 17.7, 21.8])).mask(GRID), GRID)


def cell(case, method, asd, *, drawing=THIN, cohort="talus", seconds=0.5, refusal="", digest="d", tag=""):
    key = CellKey(cohort, case, drawing, MethodName(method), digest, tag)
    figures = [math.nan] * 4 if refusal else [1 - asd / 10, asd, 2 * asd, 3 * asd]
    return Cell(key, *figures, seconds / 2, seconds, seconds, 100.0, refusal)


def peaks_of_no_work_and_of_a_large_array():
    """Both in one process, which is to be fresh: one that has run for long gives memory back meanwhile."""
    return with_peak(lambda: None)[1], with_peak(lambda: np.ones(30_000_000).sum())[1]


def plan_of(cases, methods, drawings=(THIN, ORTHOGONAL)):
    plan = CohortPlan("talus", tuple(cases), 1, Sources(None, None), True, "")
    return tasks_of([plan], drawings, methods, "t")


class TestCells:
    def test_what_is_written_is_read_back(self, tmp_path):
        file = CellFile(tmp_path / "deep" / "cells.jsonl")
        assert file.read() == {}
        written = [cell("a", "pca", 0.3), cell("b", "itk", math.inf), cell("c", "pca", 0.0, refusal="no, sorry")]
        file.append(written[:1])
        file.append(written[1:])
        found = file.read()
        assert list(found) == [one.key for one in written]
        assert found[written[0].key] == written[0]
        assert math.isinf(found[written[1].key].asd_mm)
        assert math.isnan(found[written[2].key].asd_mm)
        assert not found[written[2].key].measured

    def test_a_line_that_was_cut_off_is_passed_over_and_the_next_stands_alone(self, tmp_path):
        file = CellFile(tmp_path / "cells.jsonl")
        file.append([cell("a", "pca", 0.3), cell("b", "pca", 0.4)])
        whole = file.path.read_bytes()
        file.path.write_bytes(whole[:-20])
        assert [key.case for key in file.read()] == ["a"]
        file.append([cell("c", "pca", 0.5)])
        assert [key.case for key in file.read()] == ["a", "c"]

    def test_bundles_and_tags_are_kept_apart(self, tmp_path):
        file = CellFile(tmp_path / "cells.jsonl")
        file.append([cell("a", "pca", 0.3), cell("a", "pca", 0.2, digest="e"), cell("a", "pca", 0.1, tag="new")])
        assert len(file.read()) == 3


class TestPlan:
    def test_methods_get_the_drawings_that_they_take(self):
        drawings = list(DrawingName)
        tasks = plan_of([ellipsoid_case()], [MethodName.SIGNED_DISTANCE, MethodName.ITK], drawings)
        taken = {task.method: [key.drawing for key in task.keys] for task in tasks}
        assert taken[MethodName.SIGNED_DISTANCE] == [DrawingName.THIN, DrawingName.THICK]
        assert taken[MethodName.ITK] == [DrawingName.THIN, DrawingName.THICK, DrawingName.ORTHOGONAL]

    def test_what_is_there_is_not_measured_again(self):
        tasks = plan_of([ellipsoid_case(name) for name in "abc"], [MethodName.ITK])
        keys = keys_of(tasks)
        assert keys_of(without(tasks, keys[:4])) == keys[4:]
        assert without(tasks, keys) == []
        assert keys_of(without(tasks, [cell("a", "itk", 0.1, tag="other").key])) == keys

    def test_every_drawing_can_be_taken_by_a_model(self):
        assert not any(reason_against(MethodName.PROJECT, name) for name in DrawingName)


class TestMeasuring:
    def test_the_dense_mask_agrees_with_itself(self):
        case = ellipsoid_case()
        found = measure(cell("a", "itk", 0.0).key, case, lambda drawing, grid: Filled(case.mask, 0.25))
        assert (found.dice, found.asd_mm, found.fit_s) == (1.0, 0.0, 0.25)
        assert found.peak_mib > 0

    def test_a_refusal_is_an_answer(self):
        key = cell("a", "signed-distance", 0.0, drawing=ORTHOGONAL).key
        found = measure(key, ellipsoid_case(), make_fill(MethodName.SIGNED_DISTANCE, Sources(None, None)))
        assert "axis" in found.refusal
        assert math.isnan(found.asd_mm)

    @pytest.mark.slow
    def test_tasks_run_in_processes_of_their_own_and_a_fault_ends_one_alone(self):
        case = ellipsoid_case()
        (good,) = plan_of([case], [MethodName.SIGNED_DISTANCE])
        bad = Task(good.method, good.sources, good.keys, {})
        found = []
        faults = measure_all([good, bad], 2, found.append)
        assert [one.key for one in found] == list(good.keys)
        assert len(faults) == 1
        assert "talus" in faults[0]

    def test_the_peak_of_large_work_is_larger(self):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            small, large = pool.submit(peaks_of_no_work_and_of_a_large_array).result()
        assert large >= small + 100


class TestSummary:
    cells = (
        cell("a", "project", 0.2, seconds=0.5),
        cell("b", "project", 0.4, seconds=1.5),
        cell("a", "itk", 1.0, seconds=2.0),
        cell("b", "itk", 0.0, refusal="one slice only"),
        cell("a", "adam", 0.25, seconds=200.0),
    )

    def test_means_are_over_figures_and_ratios_over_common_cases(self):
        rows = summarise(self.cells)
        project, itk = (row_of(rows, "talus", THIN, MethodName(name)) for name in ("project", "itk"))
        assert project.mean["asd_mm"] == pytest.approx(0.3)
        assert project.deviation["asd_mm"] == pytest.approx(0.1)
        assert (itk.cases, itk.refused) == (1, 1)
        assert itk.asd_ratio == pytest.approx(0.2)
        assert itk.time_ratio == pytest.approx(4.0)

    def test_targets_of_known_cells(self):
        found = {target.words: target for target in targets_of(summarise(self.cells))}
        best = found["talus, thin: ASD by the best interpolation's (ITK contours)"]
        assert (best.figure, best.limit, best.reached) == (pytest.approx(0.2), 0.65, True)
        faster = found["talus, thin, 1 case(s): fit, times faster than the predecessor's"]
        assert faster.figure == pytest.approx(400.0)
        assert faster.reached

    def test_a_figure_that_does_not_exist_is_not_reached(self):
        assert not Target("", math.nan, 1.0).reached
        assert Target("", 1.0, 1.0).reached
        assert not Target("", 199.0, 200.0, at_most=False).reached

    def test_the_table_of_known_cells(self):
        rows = summarise([*self.cells, cell("a", "project", 0.3, drawing=DrawingName.PLANES_3)])
        text = as_markdown(rows, targets_of(rows))
        assert "| thin | MorphoFlow | 2 | 0.970 ± 0.010 | 0.300 ± 0.100 | 0.60 | 0.50 | 1.00 | 100 |  |  |" in text
        assert "| thin | ITK contours | 1 (1 refused) | 0.900 ± 0.000 | 1.000 ± 0.000 |" in text
        assert "| planes-3 | ITK contours | (takes slices along the voxel axes only) |" in text
        assert "0.20 | at most 0.65 | reached |" in text

    def test_csv_has_a_line_a_cell(self):
        stream = io.StringIO()
        write_csv(self.cells, stream)
        rows = list(DictReader(io.StringIO(stream.getvalue())))
        assert [row["method"] for row in rows] == ["project", "project", "itk", "itk", "adam"]
        assert rows[3]["refusal"] == "one slice only"


class TestPage:
    def test_only_the_generated_part_changes(self):
        page = f"# Measured\n\nwords\n\n{BEGIN}\n\nold\n\n{END}\n\nmore\n"
        found = with_generated(page, r"new \1 text")
        assert "old" not in found
        assert found.startswith("# Measured\n\nwords\n")
        assert found.endswith("more\n")
        assert with_generated(found, r"new \1 text") == found

    def test_a_page_without_marks_gets_them_at_its_end(self):
        assert with_generated("# Measured\n", "new").endswith(f"{BEGIN}\n\nnew\n\n{END}\n")


class TestPictures:
    def test_best_median_and_worst(self):
        cells = [cell(name, "project", asd) for name, asd in zip("abcde", (0.5, 0.1, 0.3, 0.9, 0.2), strict=True)]
        assert [(one.words, one.case) for one in best_median_worst(cells, THIN)] == [
            ("best", "b"),
            ("median", "c"),
            ("worst", "d"),
        ]
        assert len(best_median_worst(cells[:1], THIN)) == 1
        assert best_median_worst([], THIN) == []

    def test_the_truth_has_no_error(self):
        case = ellipsoid_case()
        assert surface_error(case, truth_surface(case)).max() < 0.3

    def test_outlines_lie_on_the_object(self):
        case = ellipsoid_case()
        for name in (THIN, DrawingName.PLANES_3):
            lines = contours(draw(case, name))
            assert len(lines) >= 3
            offset = (np.concatenate(lines) - [19.6, 17.7, 21.8]) / [13.0, 11.0, 17.0]
            assert np.abs(np.linalg.norm(offset, axis=1) - 1.0).max() < 0.15
