"""Models and results on the page: what is shown is what was chosen last."""

import re

import pytest
from playwright.sync_api import expect

from tests.page_parts import visiting

pytestmark = pytest.mark.slow
MISSING = "status of 404"


def modes(visit):
    return visit.shown(".mode label").all_inner_texts()


def begin_model(visit, model):
    visit.go(f"#/explore?model={model}")
    expect(visit.shown(".mode label").first).to_be_visible()


def open_model(visit, model):
    begin_model(visit, model)
    expect(visit.page.get_by_text("8 shapes.")).to_be_visible()


def test_the_model_that_was_chosen_last_is_shown_whichever_answers_last(browser, address):
    with visiting(browser, address) as visit:
        begin_model(visit, "talus")
        wanted = modes(visit)
    with visiting(browser, address) as visit:
        begin_model(visit, "adrenal")
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
        begin_model(visit, "hippocampus")
        compare(visit, name, f"{name} as well")
        told = visit.shown(".compare [role=alert]")
        expect(told).to_contain_text("no reconstruction of this identifier")
        expect(told).to_be_in_viewport()


def compare(visit, *names):
    """Ask for a comparison once nothing above it grows any more."""
    expect(visit.shown(".shapes li")).to_have_count(8)
    for place, name in zip(("First result", "Second result"), names, strict=True):
        visit.page.get_by_role("combobox", name=place).fill(name)
    visit.page.get_by_role("button", name="Compare").click()


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("", ""), "Choose two results"),
        (("one", ""), "Choose two results"),
        (("one", "http://elsewhere/#/result/one"), "Both are the same result"),
    ],
)
def test_a_comparison_needs_two_results(browser, address, names, words):
    with visiting(browser, address) as visit:
        visit.go("#/explore")
        compare(visit, *names)
        told = visit.shown(".compare [role=alert]")
        expect(told).to_contain_text(words)
        expect(told).to_be_in_viewport()


def test_two_different_results_are_offered_and_only_those_that_are_known(browser, address):
    def known(*ids):
        results = [{"id": one, "label": one} for one in ids]
        visit.page.evaluate("(known) => sessionStorage.setItem('morphoflow-results', JSON.stringify(known))", results)
        for part in ("Reconstruct", "Explore"):
            visit.page.get_by_role("link", name=part, exact=True).click()

    with visiting(browser, address) as visit:
        visit.go()
        places = [visit.page.get_by_role("combobox", name=f"{n} result") for n in ("First", "Second")]
        for ids, offered in ((("a",), ("a", "")), (("b", "a"), ("a", "b")), (("c", "b"), ("c", "b"))):
            known(*ids)
            for place, value in zip(places, offered, strict=True):
                expect(place).to_have_value(value)


def test_what_went_wrong_with_a_slider_is_told_until_it_moves_again(browser, address):
    with visiting(browser, address, expected="ERR_FAILED") as visit:
        open_model(visit, "hippocampus")
        visit.page.route("**/shape?*mode=*", lambda route: route.abort())
        slider = visit.page.get_by_label(re.compile("^Mode 1 "))
        slider.fill("1")
        told = visit.shown(".modes [role=alert]")
        expect(told).to_contain_text("does not answer")
        expect(visit.page.get_by_text("8 shapes.")).to_be_visible()
        visit.page.unroute("**/shape?*mode=*")
        slider.fill("2")
        expect(visit.page.get_by_text("Full resolution.")).to_be_visible()
        expect(told).to_have_count(0)
