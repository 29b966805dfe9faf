"""What tests of the page share: visits without a network, on which nothing goes wrong."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, ConsoleMessage, Locator, Page, Route, expect

from benchmarks.browser import browsing, chromium

WIDE = {"width": 1360, "height": 900}
PHONE = {"width": 360, "height": 740}
PATIENCE_MS = 60_000


@contextmanager
def patient_browser() -> Iterator[Browser]:
    """A browser that may take its time; skips where Debian's is not installed."""
    program = chromium()
    if program is None:
        pytest.skip("no browser (Debian: chromium)")
    expect.set_options(timeout=PATIENCE_MS)
    with browsing(program) as browser:
        yield browser


@dataclass
class Visit:
    """A page that is open, and what must not happen on it."""

    page: Page
    address: str
    errors: list[str] = field(default_factory=list)
    strangers: list[str] = field(default_factory=list)

    def go(self, part: str = "") -> None:
        """Open a part of the page."""
        self.page.goto(f"{self.address}/{part}")

    def shown(self, selector: str) -> Locator:
        """What a selector finds among what is shown."""
        return self.page.locator(selector).locator("visible=true")


@contextmanager
def visiting(
    browser: Browser, address: str, *, viewport: Mapping[str, int] = WIDE, expected: str = "", **context
) -> Iterator[Visit]:
    """A visit without a network beside the service; afterwards nothing went wrong and nobody else was asked.

    Args:
        address: of the service, with the page's prefix.
        expected: messages of the console with this text are no errors.
    """
    opened = browser.new_context(viewport=dict(viewport), accept_downloads=True, **context)
    opened.set_default_timeout(PATIENCE_MS)
    visit = Visit(opened.new_page(), address)

    def guard(route: Route) -> None:
        if urlsplit(route.request.url).netloc == urlsplit(address).netloc:
            route.continue_()
        else:
            visit.strangers.append(route.request.url)
            route.abort()

    def listen(message: ConsoleMessage) -> None:
        if message.type in ("error", "warning") and not (expected and expected in message.text):
            visit.errors.append(message.text)

    opened.route("**/*", guard)
    visit.page.on("console", listen)
    visit.page.on("pageerror", lambda fault: visit.errors.append(str(fault)))
    try:
        yield visit
    finally:
        opened.close()
    assert not visit.errors, visit.errors
    assert not visit.strangers, visit.strangers


def take_example(visit: Visit) -> None:
    """Open the page with the example's mask; it is read, and not reconstructed."""
    visit.go()
    visit.page.get_by_role("button", name="Take the example").click()
    expect(visit.page.get_by_text("3 annotated planes found")).to_be_visible()


def drop(visit: Visit, data: bytes, *names: str) -> None:
    """Drop files of the same content onto the page."""
    visit.page.locator(".drop").evaluate(
        """(zone, [data, names]) => {
            const dropped = new DataTransfer()
            for (const name of names) dropped.items.add(new File([new Uint8Array(data)], name))
            zone.dispatchEvent(new DragEvent('drop', { dataTransfer: dropped, bubbles: true, cancelable: true }))
        }""",
        [list(data), names],
    )


def reconstruct(visit: Visit) -> None:
    """Send what was chosen, and wait for the result."""
    visit.page.get_by_role("button", name="Reconstruct", exact=True).click()
    expect(visit.shown(".figures")).to_be_visible()


def picture(locator: Locator) -> bytes:
    """What an element looks like."""
    return locator.screenshot()


def serious(visit: Visit) -> list[str]:
    """Serious and critical findings of axe-core."""
    found = Axe().run(visit.page, options={"resultTypes": ["violations"]}).response["violations"]
    return [
        f"{item['id']}: {node['target']} {node['failureSummary']}"
        for item in found
        if item["impact"] in ("serious", "critical")
        for node in item["nodes"]
    ]


def overflow(visit: Visit) -> int:
    """Pixels by which the page is wider than the screen."""
    return int(visit.page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth"))
