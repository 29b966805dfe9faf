import os
import subprocess
import sys
from pathlib import Path

import pytest

from service.jobs.priority import AUTOGROUP, stand_back

PROGRAM = (
    "from service.jobs.priority import AUTOGROUP, stand_back\n"
    "stand_back(7)\n"
    "print(AUTOGROUP.read_text() if AUTOGROUP.exists() else '')"
)


def test_a_process_stands_back_from_others_and_its_session_from_other_sessions(repository):
    reached = os.nice(0) + 7
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=repository,
        env={**os.environ, "PYTHONPATH": str(repository)},
        capture_output=True,
        text=True,
        check=True,
        start_new_session=True,
    )
    if not AUTOGROUP.exists():
        pytest.skip("this kernel has no autogroups")
    assert done.stdout.split()[-2:] == ["nice", str(reached)]


@pytest.mark.parametrize("place", ["absent/autogroup", ""])
def test_where_sessions_have_no_value_the_process_alone_stands_back(tmp_path: Path, place):
    assert stand_back(0, tmp_path / place) == os.nice(0)
