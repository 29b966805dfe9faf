"""The page at / as people use it: in Debian's Chromium against the real service, with nothing else to be reached."""

import json
import re
from gzip import decompress as gunzip

import httpx
import nibabel as nib
import nrrd
import numpy as np
import pytest
from playwright.sync_api import expect

from benchmarks.browser import drag_ellipse
from service.app import create_app
from service.settings import Settings
from tests.dicom_parts import file_bytes, mr_series, seg_of
from tests.page_parts import (
    PHONE,
    drop,
    overflow,
    picture,
    reconstruct,
    serious,
    take_example,
    visiting,
)
from tests.service_parts import behind_prefix, running

pytestmark = pytest.mark.slow
UP, DOWN, LEFT, RIGHT = (f"Shift+Arrow{way}" for way in ("Up", "Down", "Left", "Right"))
EXAMPLE = "docs/examples/hippocampus_three_slices.nii.gz"


@pytest.fixture
def visit(browser, address):
    with visiting(browser, address) as opened:
        yield opened


def volume_of(visit):
    return visit.shown(".figures .value").first.inner_text()


def test_the_example_becomes_a_surface_to_be_turned_coloured_and_cut(visit):
    take_example(visit)
    assert "1 sagittal, 1 coronal, 1 axial" in visit.shown(".preview").inner_text()
    reconstruct(visit)
    expect(visit.shown(".stage .legend")).to_contain_text("Standard deviation of the surface (mm)")
    assert re.search(r"\d mL\n90 %: ", visit.shown(".figures").inner_text())
    surface = visit.shown(".surface-view canvas")
    seen = [picture(surface)]
    for change in (
        lambda: surface.press("ArrowLeft"),
        lambda: visit.page.get_by_label("Colour", exact=True).select_option("plain"),
        lambda: visit.page.get_by_label("Opacity").fill("40"),
        lambda: visit.page.get_by_label("Drawn planes").check(),
        lambda: visit.page.get_by_label("Clip plane").fill("50"),
    ):
        change()
        seen.append(picture(surface))
        assert seen[-1] != seen[-2]


def test_sections_scroll_and_show_segmentation_or_entropy(visit):
    take_example(visit)
    reconstruct(visit)
    pane = visit.shown(".slices [data-plane=coronal]")
    expect(pane).to_be_visible()
    canvas, slider = pane.locator("canvas"), pane.get_by_role("slider")
    first = picture(canvas)
    slider.press("ArrowRight")
    scrolled = picture(canvas)
    assert scrolled != first
    canvas.hover()
    visit.page.mouse.wheel(0, -40)
    expect(slider).to_have_attribute("aria-valuetext", re.compile("^28 of"))
    visit.page.get_by_label("What the sections show").select_option("segmentation")
    assert picture(canvas) != first


def test_every_format_is_saved_and_the_link_opens_the_result_again(browser, address, visit):
    take_example(visit)
    reconstruct(visit)
    choice = visit.page.get_by_label("Download", exact=True)
    saved = {}
    for option in choice.locator("option").all():
        choice.select_option(option.get_attribute("value"))
        with visit.page.expect_download() as waiting:
            visit.shown(".downloads button").first.click()
        saved[waiting.value.suggested_filename] = waiting.value.path().read_bytes()
    assert {name.split(".", 1)[1] for name in saved} == {
        *("ply", "stl", "obj", "glb", "3mf", "vtp", "mz3", "nii.gz", "json")
    }
    assert len(saved) == 12
    assert saved["surface.ply"].startswith(b"ply")
    assert json.loads(saved["summary.json"])["model"]["name"] == "hippocampus"
    link = visit.page.get_by_label("Link to this result").input_value()
    with visiting(browser, address) as later:
        later.page.goto(link)
        expect(later.shown(".figures")).to_be_visible()
        assert volume_of(later) == volume_of(visit)
        expect(later.shown(".slices [data-plane=axial]")).to_be_visible()


def test_masks_of_every_kind_are_dropped_and_shown_before_they_are_sent(visit, repository, tmp_path):
    image = nib.load(repository / EXAMPLE)
    values = np.asarray(image.dataobj, np.uint8)
    header = {"space": "RAS", "space directions": image.affine[:3, :3].T, "space origin": image.affine[:3, 3]}
    nrrd.write(str(tmp_path / "mask.nrrd"), values, {**header, "kinds": ["domain"] * 3})
    images = mr_series(values.shape, origin=(26.0, 18.0, -12.0))
    (tmp_path / "mask.dcm").write_bytes(file_bytes(seg_of(images, values[..., None][..., 0])))
    visit.go()
    for file, planes in ((repository / EXAMPLE, 3), (tmp_path / "mask.nrrd", 3), (tmp_path / "mask.dcm", 3)):
        visit.page.get_by_label("Choose mask files").set_input_files(file)
        expect(visit.page.get_by_text(f"{planes} annotated planes found")).to_be_visible()
        visit.page.get_by_role("button", name=f"Remove {file.name}").click()
    expect(visit.page.get_by_role("button", name="Reconstruct", exact=True)).to_be_disabled()


def test_what_cannot_be_read_is_told_in_the_services_words(browser, address, repository, tmp_path):
    whole = (repository / EXAMPLE).read_bytes()
    files = {"letter.nii": b"Dear reader", "half.nii.gz": whole[: len(whole) // 2], "short.nii": gunzip(whole)[:2000]}
    with visiting(browser, address, expected="status of 4") as visit:
        visit.go()
        for name, data in files.items():
            (tmp_path / name).write_bytes(data)
            told = httpx.post(f"{address}/v1/planes", files={"mask": (name, data)}).json()["detail"]
            assert "mask[0]" in told
            visit.page.get_by_label("Choose mask files").set_input_files(tmp_path / name)
            expect(visit.page.get_by_role("alert").filter(has_text=told)).to_be_visible()
            visit.page.get_by_role("button", name=f"Remove {name}").click()
            expect(visit.page.get_by_text(told)).to_have_count(0)


def test_a_dropped_file_is_taken(visit, repository):
    visit.go()
    drop(visit, (repository / EXAMPLE).read_bytes(), "dropped.nii.gz")
    expect(visit.page.get_by_text("3 annotated planes found")).to_be_visible()


def test_contours_drawn_by_hand_become_a_surface_that_follows_the_pen(visit):
    visit.go("#/draw")
    drag_ellipse(visit.page, "axial", 0.12, 0.3)
    expect(visit.page.get_by_text("Draw on a second one")).to_be_visible()
    drag_ellipse(visit.page, "sagittal", 0.3, 0.1)
    expect(visit.page.get_by_text(re.compile("Surface from 2 planes"))).to_be_visible()
    expect(visit.shown(".stage .legend")).to_be_visible()
    go = visit.page.get_by_role("button", name=re.compile("^Go to"))
    name, number = re.search(r"Go to (\w+) slice (\d+)", go.inner_text()).groups()
    go.click()
    place = visit.shown(f"[data-plane={name}] .place")
    expect(place).to_have_text(re.compile(f"^{number} of"))
    visit.page.keyboard.press("Control+z")
    expect(visit.page.get_by_text("Draw on a second one")).to_be_visible()
    visit.page.keyboard.press("Control+y")
    expect(visit.page.get_by_text(re.compile("Surface from 2 planes"))).to_be_visible()
    visit.page.get_by_role("link", name="All figures").click()
    expect(visit.shown(".figures")).to_be_visible()


def test_corners_brush_and_eraser_change_what_is_drawn(visit):
    visit.go("#/draw")
    canvas = visit.shown("[data-plane=axial] canvas")
    expect(canvas).to_be_visible()
    empty = picture(canvas)
    box = canvas.bounding_box()
    at = {"x": box["width"] / 2, "y": box["height"] / 2}
    for dx, dy in ((-30, -50), (30, -50), (30, 50), (-30, 50), (-30, -50)):
        canvas.click(position={"x": at["x"] + dx, "y": at["y"] + dy})
    visit.page.mouse.move(0, 0)
    square = picture(canvas)
    assert square != empty
    visit.page.get_by_label("Brush", exact=True).check()
    canvas.click(position={"x": at["x"] + 60, "y": at["y"]})
    brushed = picture(canvas)
    assert brushed != square
    visit.page.get_by_label("Erase").check()
    canvas.click(position=at)
    assert picture(canvas) not in (square, brushed)
    undo = visit.page.get_by_role("button", name="Undo")
    for _ in range(3):
        undo.click()
    expect(undo).to_be_disabled()
    visit.page.get_by_role("heading", name="Draw").click()
    assert picture(canvas) == empty


def test_a_contour_is_drawn_with_keys_alone(visit):
    visit.go("#/draw")
    for plane in ("axial", "coronal"):
        canvas = visit.shown(f"[data-plane={plane}] canvas")
        canvas.focus()
        for key in (UP, UP, "Space", RIGHT, DOWN, DOWN, "Space", DOWN, DOWN, LEFT, "Space", "Enter"):
            visit.page.keyboard.press(key)
    expect(visit.page.get_by_text(re.compile("Surface from 2 planes"))).to_be_visible()


def test_an_image_lies_under_the_drawing(visit, tmp_path):
    rng = np.random.default_rng(0)
    affine = np.diag([1.0, 1.2, 1.0, 1.0])
    nib.save(nib.Nifti1Image(rng.normal(size=(50, 60, 40)).astype(np.float32), affine), tmp_path / "image.nii.gz")
    visit.go("#/draw")
    canvas = visit.shown("[data-plane=axial] canvas")
    empty = picture(canvas)
    visit.page.get_by_label("Image to draw on").set_input_files(tmp_path / "image.nii.gz")
    expect(visit.page.get_by_text("Drawing on image.nii.gz")).to_be_visible()
    expect(visit.shown("[data-plane=axial] .place")).to_contain_text("of 40")
    assert picture(visit.shown("[data-plane=axial] canvas")) != empty
    drag_ellipse(visit.page, "axial", 0.12, 0.3)
    drag_ellipse(visit.page, "coronal", 0.12, 0.1)
    expect(visit.page.get_by_text(re.compile("Surface from 2 planes"))).to_be_visible()


def gallery(visit):
    """The pictures of the shapes, as soon as they stay as they are."""
    expect(visit.page.get_by_text("8 shapes.")).to_be_visible()
    found: list[str] = []
    for _ in range(20):
        before, found = found, [c.evaluate("c => c.toDataURL()") for c in visit.shown(".shapes canvas").all()]
        if found == before and len(set(found)) == 8:
            break
        visit.page.wait_for_timeout(500)
    return found


def test_the_gallery_shows_the_same_shapes_when_it_is_loaded_again(visit):
    visit.go("#/explore?seed=40")
    first = gallery(visit)
    assert len(set(first)) == 8
    visit.page.reload()
    assert gallery(visit) == first
    visit.page.get_by_role("button", name="Next shapes").click()
    expect(visit.page.get_by_text("Seed 48", exact=True)).to_be_visible()
    assert set(gallery(visit)).isdisjoint(first)
    assert "seed=48" in visit.page.url
    with visit.page.expect_download() as waiting:
        visit.page.get_by_role("button", name="Download shape of seed 48 as STL").click()
    assert waiting.value.path().stat().st_size > 84


def test_sliders_move_the_mean_shape_along_its_modes(visit):
    visit.go("#/explore")
    surface = visit.shown(".modes .surface-view canvas")
    expect(surface).to_have_attribute("data-drawn", re.compile("[1-9]"))
    mean = picture(surface)
    slider = visit.page.get_by_label(re.compile("^Mode 1 "))
    slider.fill("2.5")
    expect(visit.page.get_by_text("Full resolution.")).to_be_visible()
    moved = picture(surface)
    assert moved != mean
    visit.page.get_by_label(re.compile("^Mode 2 ")).press("Home")
    expect(visit.page.locator(".modes")).to_have_attribute("data-latency", re.compile(r"\d"))
    expect(slider).to_have_attribute("aria-valuetext", "+2.5 SD")
    visit.page.get_by_role("button", name="Back to the mean").click()
    expect(slider).to_have_value("0")


def test_two_results_lie_side_by_side_coloured_by_their_distance(visit):
    take_example(visit)
    reconstruct(visit)
    visit.page.get_by_text("More options").click()
    visit.page.get_by_label("Fidelity").fill("0")
    visit.page.get_by_role("button", name="Reconstruct", exact=True).click()
    expect(visit.page.get_by_role("button", name="Cancel")).to_be_hidden()
    visit.page.get_by_role("link", name="Explore").click()
    visit.page.get_by_role("button", name="Compare").click()
    expect(visit.page.get_by_text(re.compile(r"Distance \d\.\d\d mm on average"))).to_be_visible()
    expect(visit.shown(".compare .legend")).to_contain_text("Signed distance (mm)")
    first, second = visit.shown(".compare .surface-view canvas").all()
    before = picture(second)
    first.press("ArrowRight")
    assert picture(second) != before


def test_work_can_be_cancelled(visit):
    take_example(visit)
    visit.page.get_by_label("Uncertainty", exact=True).select_option("ensemble")
    visit.page.get_by_role("button", name="Reconstruct", exact=True).click()
    expect(visit.page.get_by_label("Progress")).to_have_js_property("value", 0)
    visit.page.get_by_role("button", name="Cancel").click()
    expect(visit.page.get_by_text("Cancelled.")).to_be_visible()
    expect(visit.shown(".preview")).to_be_visible()
    visit.page.get_by_label("Uncertainty", exact=True).select_option("none")
    reconstruct(visit)


def test_the_page_asks_for_the_key_behind_a_prefix_and_keeps_it_in_the_tab(browser, shipped_bundles, tmp_path):  # noqa: ARG001
    app = create_app(Settings(results_folder=tmp_path, api_keys=("open-sesame",)))
    with (
        running(behind_prefix(app, "/shape")) as client,
        visiting(browser, f"{client.base_url}/shape", expected="status of 401") as visit,
    ):
        visit.go()
        for key in ("wrong", "open-sesame"):
            visit.page.get_by_label("Key", exact=True).fill(key)
            visit.page.get_by_role("button", name="Use this key").click()
            if key == "wrong":
                expect(visit.page.get_by_text("does not accept that key")).to_be_visible()
        take_example(visit)
        reconstruct(visit)
        assert visit.page.evaluate("[localStorage.length, Object.values(sessionStorage).includes('open-sesame')]") == [
            0,
            True,
        ]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_serious_hinders_anybody(browser, address, scheme):
    with visiting(browser, address, color_scheme=scheme) as visit:
        visit.go()
        assert serious(visit) == []
        take_example(visit)
        assert serious(visit) == []
        reconstruct(visit)
        visit.page.get_by_text("Agreement with each").click()
        assert serious(visit) == []
        visit.page.get_by_role("link", name="Draw", exact=True).click()
        expect(visit.shown("[data-plane=axial] canvas")).to_be_visible()
        assert serious(visit) == []
        visit.page.get_by_role("link", name="Explore").click()
        gallery(visit)
        assert serious(visit) == []


def test_colours_are_the_systems_or_the_readers_choice(browser, address):
    with visiting(browser, address, color_scheme="light") as visit:
        visit.go()
        ground = "getComputedStyle(document.body).backgroundColor"
        light = visit.page.evaluate(ground)
        visit.page.get_by_label("Colours of the page").select_option("dark")
        dark = visit.page.evaluate(ground)
        visit.page.reload()
        assert visit.page.evaluate(ground) == dark != light


def test_a_phone_shows_everything_without_sideways_scrolling(browser, address):
    with visiting(browser, address, viewport=PHONE, has_touch=True, is_mobile=True) as visit:
        visit.go()
        assert overflow(visit) <= 0
        take_example(visit)
        reconstruct(visit)
        assert overflow(visit) <= 0
        for part in ("Draw", "Explore"):
            visit.page.get_by_role("link", name=part, exact=True).click()
            expect(visit.page.get_by_role("heading", name=part, exact=True)).to_be_visible()
            assert overflow(visit) <= 0
        gallery(visit)
        assert overflow(visit) <= 0
