"""From files to a result on the page: it tells of what is there now, and of nothing else."""

import json
import re
from itertools import pairwise

import httpx
import nibabel as nib
import numpy as np
import pytest
from playwright.sync_api import expect

from benchmarks.browser import drag_ellipse
from model.inference.typicality import ATYPICAL_PERCENTILE
from tests.page_parts import drop, reconstruct, take_example, visiting

pytestmark = pytest.mark.slow
EXAMPLE = "docs/examples/hippocampus_three_slices.nii.gz"
#: Voxels (0.5 mm) of the half axes of an ellipsoid of the size of a talus.
HALF_AXES = (50, 36, 34)


@pytest.fixture
def visit(browser, address):
    with visiting(browser, address) as opened:
        yield opened


def ellipsoid(half_axes):
    """A volume whose middle an ellipsoid fills."""
    axes = [np.arange(2 * half + 9) - (half + 4) for half in half_axes]
    away = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return ((away / half_axes) ** 2).sum(axis=-1) <= 1.0


@pytest.fixture
def large(tmp_path):
    """Three planes of an object of a quarter of a million voxels."""
    inside = ellipsoid(HALF_AXES)
    drawn = np.zeros(inside.shape, np.uint8)
    for axis, size in enumerate(inside.shape):
        middle = tuple(size // 2 if other == axis else slice(None) for other in range(3))
        drawn[middle] = inside[middle]
    file = tmp_path / "large.nii.gz"
    nib.save(nib.Nifti1Image(drawn, np.diag([0.5, 0.5, 0.5, 1.0])), file)
    return file


def choose(visit, *files):
    visit.page.get_by_label("Choose mask files").set_input_files(files)


def test_sections_of_a_large_object_are_shown(visit, large):
    visit.go()
    visit.page.get_by_label("Model", exact=True).select_option("talus")
    visit.page.get_by_label("Uncertainty", exact=True).select_option("none")
    choose(visit, large)
    expect(visit.page.get_by_text("annotated planes found")).to_be_visible()
    reconstruct(visit)
    expect(visit.shown(".slices [data-plane=axial] canvas")).to_be_visible()


#: Counts the bytes that are handed to the graphics.
COUNTED = """
    window.handed = 0
    const hand = WebGL2RenderingContext.prototype.bufferData
    WebGL2RenderingContext.prototype.bufferData = function (target, data, ...rest) {
        window.handed += data?.byteLength ?? 0
        return hand.call(this, target, data, ...rest)
    }
"""


def test_planes_of_a_dense_object_are_shown_by_rows_not_by_voxels(visit, tmp_path):
    inside = ellipsoid((58, 43, 40))
    assert inside.sum() > 400_000
    nib.save(nib.Nifti1Image(inside.astype(np.uint8), np.diag([0.5, 0.5, 0.5, 1.0])), tmp_path / "dense.nii.gz")
    visit.page.add_init_script(COUNTED)
    visit.go()
    choose(visit, tmp_path / "dense.nii.gz")
    expect(visit.page.get_by_text("annotated planes found")).to_be_visible()
    place = visit.shown(".preview [data-plane=sagittal] .place")
    expect(place).to_have_text(re.compile(f"^{inside.shape[0] // 2 + 1} of {inside.shape[0]}"))
    expect(visit.shown(".stage canvas")).to_have_attribute("data-drawn", re.compile("[1-9]"))
    assert 0 < visit.page.evaluate("window.handed") < 100 * inside.sum()


def test_nothing_tells_of_a_file_that_was_removed(visit):
    take_example(visit)
    visit.page.get_by_role("button", name="Remove hippocampus").click()
    expect(visit.shown(".welcome")).to_be_visible()
    expect(visit.shown(".preview")).to_have_count(0)
    expect(visit.page.get_by_text("3 annotated planes found")).to_have_count(0)


def test_files_that_arrive_while_others_are_read_cancel_nothing(visit, repository):
    visit.go()
    held = []
    visit.page.route("**/v1/planes", lambda route: held.append(route))
    for _ in range(2):
        with visit.page.expect_request("**/v1/planes"):
            choose(visit, repository / EXAMPLE)
    expect(visit.page.get_by_text("Reading the masks")).to_be_visible()
    expect(visit.page.get_by_text("Cancelled.")).to_be_hidden()
    held[1].continue_()
    expect(visit.page.get_by_text("annotated planes found")).to_be_visible()


def test_the_address_is_that_of_the_result_when_the_view_is_turned_to_again(visit):
    take_example(visit)
    reconstruct(visit)
    address = visit.page.url
    assert "#/result/" in address
    visit.page.get_by_role("link", name="Draw", exact=True).click()
    visit.page.get_by_role("link", name="Reconstruct", exact=True).click()
    expect(visit.page).to_have_url(address)
    visit.page.reload()
    expect(visit.shown(".figures")).to_be_visible()


def test_the_result_that_was_turned_to_last_is_shown_whichever_answers_last(visit):
    take_example(visit)
    visit.page.get_by_label("Uncertainty", exact=True).select_option("none")
    addresses = []
    for _ in range(2):
        with visit.page.expect_response("**/v1/reconstructions"):
            visit.page.get_by_role("button", name="Reconstruct", exact=True).click()
        expect(visit.page.get_by_role("button", name="Cancel")).to_be_hidden()
        addresses.append(visit.page.url)
    first, last = addresses
    assert first != last
    held = []
    visit.page.route(f"**/v1/reconstructions/{first.rsplit('/', 1)[1]}", lambda route: held.append(route))
    with visit.page.expect_request("**/v1/reconstructions/*"):
        visit.page.goto(first)
    visit.page.goto(last)
    expect(visit.page.get_by_role("button", name="Cancel")).to_be_hidden()
    held[0].abort()
    expect(visit.page.get_by_text("Done.")).to_be_visible()
    expect(visit.page).to_have_url(last)
    expect(visit.page.get_by_label("Link to this result")).to_have_value(last)


def test_looking_up_a_link_can_be_cancelled(visit):
    take_example(visit)
    reconstruct(visit)
    visit.page.route("**/v1/reconstructions/*", lambda route: None)
    with visit.page.expect_request("**/v1/reconstructions/*"):
        visit.page.reload()
    visit.page.get_by_role("button", name="Cancel").click()
    expect(visit.page.get_by_text("Cancelled.")).to_be_visible()
    expect(visit.page.get_by_role("button", name="Cancel")).to_be_hidden()


def test_a_link_is_copied_where_the_browser_has_no_clipboard_for_it(visit):
    take_example(visit)
    reconstruct(visit)
    visit.page.evaluate("Object.defineProperty(navigator, 'clipboard', { value: undefined })")
    visit.page.get_by_role("button", name="Copy").click()
    expect(visit.page.get_by_text("Copied.")).to_be_visible()
    expect(visit.page.get_by_text("Kept until")).to_be_visible()
    visit.page.evaluate("document.execCommand = () => false")
    visit.page.get_by_role("button", name="Copy").click()
    expect(visit.page.get_by_text("the link is selected")).to_be_visible()


def test_a_link_to_nothing_is_told_in_a_sentence(browser, address):
    with visiting(browser, address, expected="status of 404") as visit:
        visit.go("#/result/%")
        expect(visit.page.get_by_role("alert").filter(has_text="no longer kept")).to_be_visible()


def told_instead(visit, **values):
    """Let the service answer other values in a result's summary."""

    def alter(route):
        answer = route.fetch()
        route.fulfill(response=answer, body=json.dumps({**answer.json(), **values}))

    visit.page.route("**/v1/reconstructions", alter)


def test_planes_in_warnings_are_named_as_the_page_shows_them(visit):
    told_instead(visit, warnings=["The drawing on mask[0] axis 2 index 14 disagrees; check it."], planes=[])
    take_example(visit)
    reconstruct(visit)
    expect(visit.shown(".warnings")).to_contain_text("The drawing on axial slice 15 of 34 disagrees")


def test_of_several_files_a_warning_names_the_one_it_means(visit, repository):
    planes = [{"stack": stack, "axis": 2, "index": 14} for stack in (0, 1)]
    told_instead(visit, warnings=["The drawing on mask[1] axis 2 index 14 disagrees."], planes=planes)
    visit.go()
    example = nib.load(repository / EXAMPLE)
    beside = example.affine.copy()
    beside[:3, 3] += 0.4
    drop(visit, (repository / EXAMPLE).read_bytes(), "left.nii.gz")
    drop(visit, nib.Nifti1Image(np.asarray(example.dataobj), beside).to_bytes(), "right.nii")
    expect(visit.page.get_by_text("6 annotated planes found")).to_be_visible()
    visit.page.get_by_label("Which file is shown").select_option("right.nii")
    reconstruct(visit)
    expect(visit.shown(".warnings")).to_contain_text("axial slice 15 of 34 of right.nii")
    visit.page.get_by_text("Agreement with each").click()
    expect(visit.shown(".residuals")).to_contain_text("Axial 15 of left.nii.gz")


@pytest.mark.parametrize(
    ("percentile", "words"),
    [(0.99 * ATYPICAL_PERCENTILE, "unlike anything"), (ATYPICAL_PERCENTILE, "rarer than 99 in 100")],
)
def test_typicality_is_called_unlike_the_model_where_the_service_warns(visit, percentile, words):
    told_instead(visit, typicality_percentile=percentile)
    take_example(visit)
    reconstruct(visit)
    expect(visit.shown(".figures")).to_contain_text(words)


def gone(route):
    route.abort()


def starting(route):
    route.fulfill(status=503, json={"title": "Not ready", "status": 503, "detail": "The models are being loaded."})


@pytest.mark.parametrize(
    ("answer", "words", "logged"),
    [(gone, "does not answer", "ERR_FAILED"), (starting, "being loaded", "status of 503")],
)
def test_models_are_listed_once_the_service_answers(browser, address, answer, words, logged):
    with visiting(browser, address, expected=logged) as visit:
        visit.page.route("**/v1/models", answer)
        visit.go()
        told = visit.page.get_by_role("alert").filter(has_text=words)
        expect(told).to_be_visible()
        visit.page.get_by_role("button", name="Take the example").click()
        with visit.page.expect_request("**/v1/models"):
            pass
        expect(visit.page.get_by_text("3 annotated planes found")).to_be_visible()
        expect(told).to_be_visible()
        visit.page.unroute("**/v1/models")
        models = httpx.get(f"{address}/v1/models").json()["models"]
        expect(visit.page.get_by_label("Model", exact=True).locator("option")).to_have_count(len(models))
        expect(told).to_have_count(0)
        expect(visit.page.get_by_text("3 annotated planes found")).to_be_visible()


def test_headings_skip_no_level(visit):
    take_example(visit)
    reconstruct(visit)
    drag = visit.page.get_by_role("link", name="Draw", exact=True)
    levels = (
        "[...document.querySelectorAll('h1, h2, h3, h4')].filter((e) => e.checkVisibility()).map((e) => +e.tagName[1])"
    )
    for part in ("Reconstruct", "Draw", "Explore"):
        if part == "Draw":
            drag.click()
            drag_ellipse(visit.page, "axial", 0.1, 0.2)
        elif part == "Explore":
            visit.page.get_by_role("link", name=part, exact=True).click()
            expect(visit.shown(".mode").first).to_be_visible()
        found = visit.page.evaluate(levels)
        assert found[0] == 1
        assert all(later - earlier <= 1 for earlier, later in pairwise(found))
