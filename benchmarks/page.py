"""How fast the page is: from a click, a lifted pen and a moved slider to the surface, and how large it is.

Starts the service with its shipped models in a process of its own and plays the page in Debian's Chromium, which draws
by software. The page measures from the event to the surface drawn; a click is measured from outside and so includes
the browser's own way.

    python -m benchmarks.page
"""

import gzip
import json
import time
from collections.abc import Callable, Sequence
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Annotated

import numpy as np
import typer
from playwright.sync_api import Browser, Page

from benchmarks.browser import browsing, chromium, drag_ellipse
from benchmarks.server import serving

VIEWPORT = {"width": 1360, "height": 900}
PATIENCE_MS = 120_000
#: An open page has settled (its viewer has started) after so long (ms), as a reader's first look takes.
SETTLING_MS = 3000


def main(
    repeats: Annotated[int, typer.Option(min=1, max=50, help="Measurements of each kind.")] = 5,
    as_json: Annotated[bool, typer.Option("--json", help="Write JSON.")] = False,
) -> None:
    """Measure the page of the running service."""
    program = chromium()
    if program is None:
        raise SystemExit("No browser; on Debian: apt-get install chromium")
    with serving(()) as server, browsing(program) as browser:
        address = str(server.client.base_url)
        kinds: dict[str, Callable[[Browser, str, int], list[float]]] = {
            "example click to coloured surface": clicks,
            "pen lifted to new surface": strokes,
            "slider moved to new surface": moves,
        }
        found = {name: measure(browser, address, repeats) for name, measure in kinds.items()}
    sizes = bundle_bytes()
    values = {
        "seconds": {name: summary(seconds) for name, seconds in found.items()},
        "bundle_gzip_bytes": sizes[0],
        "bundle_bytes": sizes[1],
    }
    typer.echo(json.dumps(values, indent=2) if as_json else as_text(found, sizes))


def clicks(browser: Browser, address: str, repeats: int) -> list[float]:
    """From the click on the example to its coloured surface (s), each in a page of its own."""
    seconds = []
    for _ in range(repeats):
        page = opened(browser, address)
        page.wait_for_timeout(SETTLING_MS)
        button = page.locator(".welcome button")
        begin = time.perf_counter()
        button.click()
        page.locator(".result .figures").wait_for()
        seconds.append(time.perf_counter() - begin)
        page.context.close()
    return seconds


def strokes(browser: Browser, address: str, repeats: int) -> list[float]:
    """From lifting the pen to the surface through all contours (s)."""
    page = opened(browser, f"{address}/#/draw")
    page.wait_for_timeout(SETTLING_MS)
    drag_ellipse(page, "axial", 0.10, 0.26)
    seconds = []
    for number in range(repeats + 1):
        before = page.locator(".split").locator("visible=true").get_attribute("data-latency")
        plane, across, down = (("sagittal", 0.22, 0.09), ("coronal", 0.1, 0.09))[number % 2]
        drag_ellipse(page, plane, across + 0.004 * number, down + 0.004 * number)
        seconds.append(latency(page, ".split", before))
    page.context.close()
    return seconds[1:]


def moves(browser: Browser, address: str, repeats: int) -> list[float]:
    """From moving a slider to the surface there (s); the finer surface that follows is not counted."""
    page = opened(browser, f"{address}/#/explore")
    page.get_by_text("8 shapes.").wait_for()
    seconds = []
    for number in range(repeats):
        before = page.locator(".modes").get_attribute("data-latency")
        page.locator("#mode-1").fill(f"{1.0 + 0.1 * number:.1f}")
        seconds.append(latency(page, ".modes", before))
        page.wait_for_timeout(1500)
    page.context.close()
    return seconds


def latency(page: Page, selector: str, before: str | None) -> float:
    """What the page measured last (s), once it is another figure than before."""
    place = page.locator(selector).locator("visible=true")
    end = time.monotonic() + PATIENCE_MS / 1000.0
    while time.monotonic() < end:
        told = place.get_attribute("data-latency")
        if told is not None and told != before:
            return float(told.split()[0]) / 1000.0
        page.wait_for_timeout(20)
    raise SystemExit(f"The page drew nothing new in {selector}.")


def opened(browser: Browser, address: str) -> Page:
    """A fresh page."""
    context = browser.new_context(viewport={"width": VIEWPORT["width"], "height": VIEWPORT["height"]})
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    page.goto(address)
    page.locator("option").nth(3).wait_for(state="attached")
    return page


def bundle_bytes() -> tuple[int, int]:
    """Size of all files of the page, compressed by gzip and as they are."""
    found = [path.read_bytes() for path in walk(files("service") / "page" / "built")]
    return sum(len(gzip.compress(data)) for data in found), sum(map(len, found))


def walk(folder: Traversable) -> list[Traversable]:
    """All files below a folder."""
    return [file for path in folder.iterdir() for file in ([path] if path.is_file() else walk(path))]


def summary(seconds: Sequence[float]) -> dict[str, float]:
    """Median and slowest."""
    return {"median": round(float(np.median(seconds)), 3), "slowest": round(max(seconds), 3)}


def as_text(found: dict[str, list[float]], sizes: tuple[int, int]) -> str:
    """A table."""
    lines = [f"{'':<36}{'n':>4}{'median s':>10}{'slowest s':>11}"]
    for name, seconds in found.items():
        told = summary(seconds)
        lines.append(f"{name:<36}{len(seconds):>4}{told['median']:>10.3f}{told['slowest']:>11.3f}")
    lines.append(f"page: {sizes[0] / 1e6:.3f} MB compressed, {sizes[1] / 1e6:.3f} MB as it is")
    return "\n".join(lines)


if __name__ == "__main__":
    typer.run(main)
