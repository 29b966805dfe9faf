"""A browser on the page of the service: Debian's Chromium, drawing by software, and a pen to draw with."""

import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Browser, Page, sync_playwright

#: Without a GPU, without a sandbox (root), and without calls of the browser's own.
FLAGS = (
    "--no-sandbox",
    "--no-first-run",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
#: Corners of a contour that `drag_ellipse` draws.
CORNERS = 24


def chromium() -> str | None:
    """Debian's browser; None where it is not installed."""
    return shutil.which("chromium")


@contextmanager
def browsing(program: str) -> Iterator[Browser]:
    """A browser without a window."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        yield browser
        browser.close()


def drag_ellipse(page: Page, plane: str, across: float, down: float) -> None:
    """Outline an ellipse in the middle of a plane; half axes as shares of the shorter side of its canvas."""
    canvas = page.locator(f"[data-plane={plane}] canvas").locator("visible=true")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    if box is None:
        raise ValueError(f"The plane {plane} is not shown.")
    size = min(box["width"], box["height"])
    for corner in range(CORNERS):
        angle = 2.0 * math.pi * corner / CORNERS
        x = box["x"] + box["width"] / 2 + size * across * math.cos(angle)
        page.mouse.move(x, box["y"] + box["height"] / 2 + size * down * math.sin(angle))
        if corner == 0:
            page.mouse.down()
    page.mouse.up()
