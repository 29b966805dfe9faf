"""The scene in full: archive, service, drawing, results; and a small storm with the service killed on the way."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.pacs.orthanc import is_installed
from benchmarks.pacs.scene import play
from benchmarks.pacs.storm import storm
from service.adapters.dicom.results import RESULTS
from service.adapters.pacs.audit import TrailCheck, check_trail

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("shipped_bundles"),
    pytest.mark.skipif(not is_installed(), reason="Orthanc is not installed (Debian: orthanc orthanc-dicomweb dcmtk)"),
]


@pytest.mark.parametrize("dicomweb", [False, True], ids=["DIMSE", "DICOMweb"])
def test_three_planes_come_back_as_results(dicomweb, tmp_path, shared_data):
    scene = play(tmp_path / "scene", shared_data, dicomweb=dicomweb)
    assert scene.results == len(RESULTS)
    assert scene.errors == ()
    assert scene.dice_archive == pytest.approx(scene.dice_rest, abs=0.002)
    assert scene.dice_archive > 0.8
    assert check_trail(tmp_path / "scene" / "service" / "audit.jsonl") == TrailCheck(None)


def test_one_command_plays_the_scene(tmp_path, repository: Path):
    """On the example where no cohort is at hand."""
    command = [sys.executable, "-m", "benchmarks.pacs", "scene", "--folder", str(tmp_path / "scene")]
    environment = {**os.environ, "MORPHOFLOW_DATA": str(tmp_path / "none")}
    run = subprocess.run(command, cwd=repository, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "The study in the archive" in run.stdout
    assert "errors that dciodvfy finds: 0" in run.stdout


def test_killed_again_and_again_every_study_gets_its_results_once(tmp_path):
    count = storm(tmp_path / "storm", studies=8, kills=3, say=lambda sentence: None)
    assert len(count.acknowledged) == len(count.results) == 8
    assert set(count.results.values()) == {len(RESULTS)}
    assert count.kills == 3
