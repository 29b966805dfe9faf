"""Models and results on the page: what is shown is what was chosen last."""

import re

import pytest
from playwright.sync_api import expect

from benchmarks.server import serving
from tests.page_parts import patient_browser, visiting

pytestmark = pytest.mark.slow
MISSING = "status of 404"


@pytest.fixture(scope="module")
def browser():
    with patient_browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def address(shipped_bundles, browser):  # noqa: ARG001 - no service where nobody can visit it
    with serving(()) as server:
        yield str(server.client.base_url)


def modes(visit):
    return visit.shown(".mode label").all_inner_texts()


def open_model(visit, model):
    visit.go(f"#/explore?model={model}")
    expect(visit.page.get_by_text("8 shapes.")).to_be_visible()


def test_the_model_that_was_chosen_last_is_shown_whichever_answers_last(browser, address):
    with visiting(browser, address) as visit:
        open_model(visit, "talus")
        wanted = modes(visit)
    with visiting(browser, address) as visit:
        open_model(visit, "adrenal")
        held = []
        visit.page.route("**/v1/models/hippocampus/modes", lambda route: held.append(route))
        choice = visit.shown(".explore-head select")
        with visit.page.expect_request("**/v1/models/hippocampus/modes"):
            choice.select_option("hippocampus")
        choice.select_option("talus")
        expect(visit.shown(".mode label").first).to_have_text(wanted[0])
        for route in held:
            route.continue_()
        expect(visit.page.get_by_text("8 shapes.")).to_be_visible()
        assert modes(visit) == wanted


def test_a_link_that_is_followed_changes_what_is_open(browser, address):
    with visiting(browser, address) as visit:
        open_model(visit, "hippocampus")
        visit.go("#/explore?model=talus&seed=100&temperature=0.5")
        expect(visit.shown(".explore-head select")).to_have_value("talus")
        expect(visit.page.get_by_text("Seed 107", exact=True)).to_be_visible()
        expect(visit.page.get_by_label("Variety")).to_have_attribute("aria-valuetext", "0.5")
        expect(visit.page).to_have_url(re.compile("model=talus&seed=100&temperature=0.5"))
        visit.go("#/explore?seed=7")
        expect(visit.page.get_by_text("Seed 14", exact=True)).to_be_visible()
        expect(visit.shown(".explore-head select")).to_have_value("talus")


@pytest.mark.parametrize("name", ["nonsense", "100%"])
def test_a_comparison_that_fails_is_told_beside_its_button(browser, address, name):
    with visiting(browser, address, expected=MISSING) as visit:
        open_model(visit, "hippocampus")
        for place in ("First result", "Second result"):
            visit.page.get_by_role("combobox", name=place).fill(name)
        visit.page.get_by_role("button", name="Compare").click()
        told = visit.shown(".compare [role=alert]")
        expect(told).to_contain_text("no reconstruction of this identifier")
        expect(told).to_be_in_viewport()
