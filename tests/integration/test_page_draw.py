"""Drawing on the page: what is drawn is not lost, and can be taken back."""

import re

import httpx
import nibabel as nib
import numpy as np
import pytest
from playwright.sync_api import expect

from benchmarks.browser import drag_ellipse
from tests.page_parts import visiting

pytestmark = pytest.mark.slow
#: Half axes of contours that fit each other, as shares of the canvas.
AXES = {"axial": (0.12, 0.3), "sagittal": (0.3, 0.1), "coronal": (0.12, 0.1)}
NOT_LOOKED_AT = 255


@pytest.fixture
def visit(browser, address):
    with visiting(browser, address) as opened:
        opened.go("#/draw")
        yield opened


def surface_from(visit, planes):
    expect(visit.page.get_by_text(re.compile(f"Surface from {planes} planes"))).to_be_visible()


def draw(visit, *planes):
    """Contours on planes, each as soon as the surface of those before is there."""
    for count, plane in enumerate(planes, start=1):
        drag_ellipse(visit.page, plane, *AXES[plane])
        if count == 1:
            expect(visit.page.get_by_text("Draw on a second one")).to_be_visible()
        else:
            surface_from(visit, count)


def button(visit, name):
    return visit.page.get_by_role("button", name=name)


def downloaded(visit, folder):
    """The drawing as its file holds it, and the file."""
    with visit.page.expect_download() as waiting:
        button(visit, "Download drawing").click()
    file = folder / waiting.value.suggested_filename
    waiting.value.save_as(file)
    return np.asarray(nib.load(file).dataobj), file


def result_of(visit, address):
    """Address of the summary of the result that is shown."""
    link = visit.shown(".told a").get_attribute("href")
    return f"{address}/v1/reconstructions/{link.removeprefix('#/result/')}"


@pytest.fixture
def image(tmp_path):
    rng = np.random.default_rng(0)
    file = tmp_path / "image.nii.gz"
    nib.save(nib.Nifti1Image(rng.normal(size=(60, 60, 40)).astype(np.float32), np.eye(4)), file)
    return file


def test_a_result_that_was_opened_outlives_the_next_strokes(visit, address):
    draw(visit, "axial", "sagittal")
    opened = result_of(visit, address)
    visit.page.get_by_role("link", name="All figures").click()
    expect(visit.shown(".figures")).to_be_visible()
    visit.page.get_by_role("link", name="Draw", exact=True).click()
    drag_ellipse(visit.page, "coronal", *AXES["coronal"])
    surface_from(visit, 3)
    unopened = result_of(visit, address)
    with visit.page.expect_response(lambda answer: answer.request.method == "DELETE"):
        button(visit, "Undo").click()
    assert httpx.get(opened).status_code == 200
    assert httpx.get(unopened).status_code == 404
    surface_from(visit, 2)
    taken = result_of(visit, address)
    assert taken not in (opened, unopened)
    visit.shown(".told a").dispatch_event("contextmenu")
    button(visit, "Redo").click()
    surface_from(visit, 3)
    with visit.page.expect_response(lambda answer: answer.request.method == "DELETE"):
        button(visit, "Undo").click()
    assert httpx.get(taken).status_code == 200


def test_another_model_takes_over_drawing_and_image(visit, address, image):
    visit.page.get_by_label("Image to draw on").set_input_files(image)
    expect(visit.page.get_by_text("Drawing on image.nii.gz")).to_be_visible()
    draw(visit, "axial", "sagittal")
    first = result_of(visit, address)
    with visit.page.expect_response(lambda answer: answer.request.method == "DELETE"):
        visit.shown(".split").get_by_label("Model").select_option("talus")
    surface_from(visit, 2)
    assert result_of(visit, address) != first
    assert httpx.get(result_of(visit, address)).json()["model"]["name"] == "talus"
    expect(visit.shown("[data-plane=axial] .place")).to_contain_text("of 40")
    expect(button(visit, "Undo")).to_be_enabled()


def test_an_empty_grid_fits_the_chosen_model_as_long_as_nothing_is_drawn(visit):
    place = visit.shown("[data-plane=axial] .place")
    before = place.inner_text()
    visit.shown(".split").get_by_label("Model").select_option("talus")
    expect(place).not_to_have_text(before)
    expect(button(visit, "Undo")).to_be_disabled()


def test_what_is_drawn_before_the_grid_of_another_model_arrives_stays(visit):
    place = visit.shown("[data-plane=axial] .place")
    before = place.inner_text()
    held = []
    visit.page.route("**/v1/models/talus", lambda route: held.append(route))
    with visit.page.expect_request("**/v1/models/talus"):
        visit.shown(".split").get_by_label("Model").select_option("talus")
    draw(visit, "axial")
    with visit.page.expect_response("**/v1/models/talus") as answered:
        held[0].continue_()
    answered.value.finished()
    drag_ellipse(visit.page, "coronal", *AXES["coronal"])
    surface_from(visit, 2)
    expect(place).to_have_text(before)


def test_a_new_grid_or_image_is_undone_as_a_stroke_is(visit, image, tmp_path):
    draw(visit, "axial")
    before, _ = downloaded(visit, tmp_path)
    button(visit, "New empty grid").click()
    expect(button(visit, "Download drawing")).to_be_disabled()
    visit.page.get_by_label("Image to draw on").set_input_files(image)
    expect(visit.page.get_by_text("Drawing on image.nii.gz")).to_be_visible()
    button(visit, "Undo").click()
    assert np.array_equal(downloaded(visit, tmp_path)[0], before)
    button(visit, "Redo").click()
    expect(visit.page.get_by_text("Drawing on image.nii.gz")).to_be_visible()
    expect(visit.shown("[data-plane=axial] .place")).to_contain_text("of 40")


def test_a_drawing_is_downloaded_with_the_planes_that_were_looked_at(visit, address, tmp_path):
    draw(visit, "axial", "coronal")
    values, file = downloaded(visit, tmp_path)
    assert set(np.unique(values)) == {0, 1, NOT_LOOKED_AT}
    answer = httpx.post(f"{address}/v1/planes", files={"mask": file.read_bytes()}).json()
    told = {(plane["axis"], plane["index"]) for plane in answer["planes"]}
    assert told == {(1, values.shape[1] // 2), (2, values.shape[2] // 2)}
    seen = np.zeros(values.shape, bool)
    for axis, index in told:
        np.moveaxis(seen, axis, 0)[index] = True
    assert np.array_equal(values != NOT_LOOKED_AT, seen)


def test_leaving_asks_as_long_as_the_drawing_is_not_saved(visit, tmp_path):
    asked = []
    visit.page.on("dialog", lambda dialog: (asked.append(dialog.type), dialog.accept()))
    draw(visit, "axial")
    downloaded(visit, tmp_path)
    visit.page.reload()
    assert asked == []
    draw(visit, "axial")
    visit.page.reload()
    assert asked == ["beforeunload"]


def test_an_erased_contour_is_as_one_that_was_never_drawn(visit, tmp_path):
    draw(visit, "sagittal", "coronal")
    before, _ = downloaded(visit, tmp_path)
    drag_ellipse(visit.page, "axial", *AXES["axial"])
    surface_from(visit, 3)
    with_axial, _ = downloaded(visit, tmp_path)
    visit.page.get_by_label("Erase").check()
    drag_ellipse(visit.page, "axial", 0.42, 0.45)
    surface_from(visit, 2)
    assert np.array_equal(downloaded(visit, tmp_path)[0], before)
    button(visit, "Undo").click()
    surface_from(visit, 3)
    assert np.array_equal(downloaded(visit, tmp_path)[0], with_axial)


def test_a_part_that_is_erased_leaves_both_planes_looked_at(visit, tmp_path):
    draw(visit, "axial", "sagittal")
    before, _ = downloaded(visit, tmp_path)
    visit.page.get_by_label("Erase").check()
    drag_ellipse(visit.page, "axial", 0.06, 0.06)
    surface_from(visit, 2)
    after, _ = downloaded(visit, tmp_path)
    assert np.array_equal(before == NOT_LOOKED_AT, after == NOT_LOOKED_AT)
    changed = np.argwhere(before != after)
    assert len(changed) > 0
    assert set(changed[:, 2]) == {before.shape[2] // 2}


def test_keys_take_strokes_back_wherever_the_focus_is(visit):
    draw(visit, "axial")
    visit.page.get_by_role("heading", name="Draw").click()
    visit.page.keyboard.press("Control+z")
    expect(visit.page.get_by_text("Drag to outline the object")).to_be_visible()
    visit.page.get_by_label("Brush radius").focus()
    visit.page.keyboard.press("Control+y")
    expect(visit.page.get_by_text("Draw on a second one")).to_be_visible()


def test_keys_take_back_the_corners_of_an_open_contour_before_anything_else(visit):
    draw(visit, "axial")
    canvas = visit.shown("[data-plane=coronal] canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    for x, y in ((0.3, 0.3), (0.7, 0.3), (0.7, 0.7), (0.3, 0.7)):
        canvas.click(position={"x": x * box["width"], "y": y * box["height"]})
    for _ in range(2):
        visit.page.keyboard.press("Control+z")
    visit.page.keyboard.press("Enter")
    expect(visit.page.get_by_text("Draw on a second one")).to_be_visible()
    expect(button(visit, "Undo")).to_be_enabled()
    visit.page.keyboard.press("Control+z")
    expect(visit.page.get_by_text("Drag to outline the object")).to_be_visible()


def test_a_damaged_image_is_refused_in_a_sentence(visit, image, tmp_path):
    whole = image.read_bytes()
    header = nib.load(image).header.binaryblock + bytes(4)
    for data in (whole[: len(whole) // 2], header + bytes(1000)):
        (tmp_path / "damaged.nii").write_bytes(data)
        visit.page.get_by_label("Image to draw on").set_input_files(tmp_path / "damaged.nii")
        expect(visit.page.get_by_role("alert").filter(has_text="damaged or ends too early")).to_be_visible()
        visit.page.get_by_label("Image to draw on").set_input_files([])
        expect(visit.page.get_by_text("Drag to outline the object")).to_be_visible()


def test_sliders_tell_their_value_with_its_unit(visit):
    radius = visit.page.get_by_label("Brush radius")
    radius.fill("3.5")
    expect(radius).to_have_attribute("aria-valuetext", "3.5 mm")
    expect(visit.shown(".tools output")).to_have_text("3.5 mm")
