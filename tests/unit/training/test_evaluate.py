import io
import json
import math
from csv import DictReader

import numpy as np
import pytest

from model.errors import UnknownModel
from model.geometry import Grid
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from training.baselines.contours import contour_fill
from training.cohorts import Case
from training.evaluate import (
    Measurement,
    Method,
    evaluate,
    fills_of,
    find_bundle,
    measure,
    methods_for,
)
from training.metrics_masks import MaskAgreement
from training.report import FIGURES, as_json, as_text, summarise, write_csv
from training.sparsify import REGIMES, for_evaluation

GRID = Grid((40, 36, 44), np.diag([1.0, 1.0, 1.0, 1.0]))


def ellipsoid_case(semi_axes=(13.0, 11.0, 17.0), name="e"):
    return Case(name, name, "test", Ellipsoid(semi_axes, np.array([19.6, 17.7, 21.8])).mask(GRID), GRID)


def measurement(case, method, asd, *, regime="thin", refusal=""):
    figures = None if refusal else MaskAgreement(dice=1 - asd / 10, asd_mm=asd, hd95_mm=2 * asd, hd_mm=3 * asd)
    return Measurement(case, regime, method, figures, 0.5, refusal)


class TestMeasure:
    def test_the_dense_mask_agrees_with_itself(self):
        case = ellipsoid_case()
        drawing = for_evaluation(case.mask, case.grid, "thin")
        found = measure(case, "thin", drawing, Method.MODEL, lambda drawing, grid: case.mask)
        assert found.agreement == MaskAgreement(1.0, 0.0, 0.0, 0.0)

    def test_a_drawing_that_a_method_cannot_take_is_an_answer(self):
        case = ellipsoid_case()
        drawing = for_evaluation(case.mask, case.grid, "orthogonal")
        fills = fills_of(ellipsoid_model(), 0)
        found = measure(case, "orthogonal", drawing, Method.SIGNED_DISTANCE, fills[Method.SIGNED_DISTANCE])
        assert found.agreement is None
        assert "axis" in found.refusal

    @pytest.mark.parametrize("regime", ["thin", "thick", "orthogonal"])
    def test_baselines_fill_between_parallel_slices_and_lose_nothing(self, regime):
        case = ellipsoid_case()
        drawing = for_evaluation(case.mask, case.grid, regime)
        fills = fills_of(ellipsoid_model(), 0)
        alone = 2 * drawing.stack.foreground.sum() / (drawing.stack.foreground.sum() + case.mask.sum())
        for method in methods_for(regime)[1:]:
            filled = measure(case, regime, drawing, method, fills[method]).agreement
            assert filled.dice >= max(alone, 0.0 if regime == "orthogonal" else 0.8)

    def test_contours_of_thick_slices_stay_centred(self):
        case = ellipsoid_case((11.0, 9.0, 15.0))
        filled = contour_fill(for_evaluation(case.mask, case.grid, "thick"), case.grid)
        assert np.allclose(np.argwhere(filled).mean(axis=0), np.argwhere(case.mask).mean(axis=0), atol=0.3)

    def test_a_model_of_the_family_beats_the_baselines(self):
        case = ellipsoid_case((12.5, 8.5, 8.0))
        model, contours = summarise(evaluate(ellipsoid_model(), [case], ["orthogonal"]))
        assert model.method is Method.MODEL
        assert model.figures["dice"].mean > 0.93
        assert contours.asd_ratio < 1.0
        assert contours.dice_gain > 0.0

    def test_every_case_and_regime_is_measured_with_every_method(self):
        cases = [ellipsoid_case((12.0, 9.0, 7.0), name) for name in "ab"]
        watched = []
        found = evaluate(ellipsoid_model(), cases, ["thick", "dense"], watch=watched.append)
        assert found == watched
        expected = [
            (regime, name, method) for regime in ("thick", "dense") for name in "ab" for method in methods_for(regime)
        ]
        assert [(one.regime, one.case, one.method) for one in found] == expected

    def test_methods_of_a_regime_begin_with_the_model(self):
        assert all(methods_for(regime)[0] is Method.MODEL for regime in REGIMES)


class TestSummary:
    def test_mean_deviation_and_ratio(self):
        found = [
            *[measurement(f"c{n}", Method.MODEL, asd) for n, asd in enumerate((0.2, 0.4))],
            *[measurement(f"c{n}", Method.ITK, asd) for n, asd in enumerate((1.0, 2.0))],
        ]
        model, itk = summarise(found)
        assert model.figures["asd_mm"].mean == pytest.approx(0.3)
        assert model.figures["asd_mm"].sd == pytest.approx(0.1)
        assert model.asd_ratio == pytest.approx(1.0)
        assert itk.asd_ratio == pytest.approx(0.2)
        assert itk.dice_gain == pytest.approx(0.12)

    def test_failures_are_counted_and_compared_over_common_cases_only(self):
        found = [
            measurement("a", Method.MODEL, 0.2),
            measurement("b", Method.MODEL, 5.0),
            measurement("a", Method.ITK, 0.4),
            measurement("b", Method.ITK, 0.0, refusal="one slice only"),
        ]
        _, itk = summarise(found)
        assert (itk.cases, itk.failed) == (1, 1)
        assert itk.figures["asd_mm"].mean == pytest.approx(0.4)
        assert itk.asd_ratio == pytest.approx(0.5)

    def test_rows_keep_the_order_of_measurement(self):
        found = [measurement("a", Method.ITK, 1.0, regime="thick"), measurement("a", Method.MODEL, 1.0, regime="thin")]
        assert [(row.regime, row.method) for row in summarise(found)] == [("thick", Method.ITK), ("thin", Method.MODEL)]

    def test_text_names_every_method_and_has_one_line_each(self):
        rows = summarise([measurement("a", Method.MODEL, 0.2), measurement("a", Method.SIGNED_DISTANCE, 0.4)])
        lines = as_text(rows).splitlines()
        assert len(lines) == 3
        assert "signed distance" in lines[2]
        assert "0.50" in lines[2]

    def test_json_is_strict_also_without_figures(self):
        rows = summarise(
            [measurement("a", Method.MODEL, 0.0, refusal="no plane"), measurement("b", Method.ITK, math.inf)]
        )
        values = json.loads(as_json(rows), parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))
        assert [row["failed"] for row in values] == [1, 0]
        assert values[0]["figures"]["dice"]["mean"] is None

    def test_csv_holds_every_measurement(self):
        found = [measurement("a", Method.MODEL, 0.25), measurement("b", Method.ITK, 0.0, refusal="no, sorry")]
        stream = io.StringIO()
        write_csv(found, stream)
        rows = list(DictReader(io.StringIO(stream.getvalue())))
        assert [row["case"] for row in rows] == ["a", "b"]
        assert float(rows[0]["asd_mm"]) == 0.25
        assert [rows[1][name] for name in FIGURES] == [""] * 4
        assert rows[1]["refusal"] == "no, sorry"


class TestFindBundle:
    def test_by_folder_and_by_name(self, tmp_path):
        bundle = tmp_path / "bundles" / "spleen"
        bundle.mkdir(parents=True)
        (bundle / "manifest.json").write_text("{}")
        assert find_bundle(str(bundle), []) == bundle
        assert find_bundle("spleen", [tmp_path / "none", tmp_path / "bundles"]) == bundle

    def test_unknown(self, tmp_path):
        with pytest.raises(UnknownModel):
            find_bundle("spleen", [tmp_path])
