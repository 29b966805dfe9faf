"""Progress as a terminal shows it."""

import os
import pty
import re
import subprocess
import sys

STEPS = """
from service.console import progress
with progress(3) as step:
    for name in ("masks", "fit", "surface"):
        step(name)
"""


def shown_on_a_terminal(program: str) -> str:
    """What a program writes to standard error when that is a terminal."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "80"}
    with subprocess.Popen([sys.executable, "-c", program], stderr=theirs, env=environment) as process:
        os.close(theirs)
        written = b""
        while part := _part(ours):
            written += part
    os.close(ours)
    assert process.returncode == 0, written
    return written.decode()


def _part(terminal: int) -> bytes:
    try:
        return os.read(terminal, 4096)
    except OSError:  # the other end is closed
        return b""


def test_a_bar_counts_the_steps_that_are_done_while_it_names_the_one_that_goes_on():
    shown = shown_on_a_terminal(STEPS)
    counts = [(int(done), int(total)) for done, total in re.findall(r"(-?\d+)/(\d+)", shown)]
    assert counts[0] == (0, 3)
    assert counts[-1] == (2, 3)
    assert shown.rindex("surface") < shown.rindex("2/3")
