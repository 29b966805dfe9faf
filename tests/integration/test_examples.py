"""The first screen of the README, run: its request against a real service, and the demo."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from urllib.error import URLError

import nibabel as nib
import numpy as np
import pytest
import trimesh

from benchmarks.ports import free_port

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("shipped_bundles")]

START_LIMIT_S = 120.0


@pytest.fixture(scope="module")
def example(repository: Path) -> Path:
    path = repository / "docs" / "examples" / "hippocampus_three_slices.nii.gz"
    assert path.exists(), "the example mask belongs to the repository once a model ships"
    return path


def is_ready(address: str) -> bool:
    try:
        return urllib.request.urlopen(f"{address}/readyz", timeout=2).status == 200
    except URLError:
        return False


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A service with the models that ship."""
    port = str(free_port())
    environment = {**os.environ, "MORPHOFLOW_RESULTS_FOLDER": str(tmp_path_factory.mktemp("results"))}
    program = Path(sys.executable).with_name("morphoflow")
    service = subprocess.Popen([program, "serve", "--port", port], env=environment, stderr=subprocess.DEVNULL)
    limit = time.monotonic() + START_LIMIT_S
    try:
        while not is_ready(f"http://127.0.0.1:{port}"):
            assert service.poll() is None, "the service ended before it was ready"
            assert time.monotonic() < limit, "the service never became ready"
            time.sleep(0.2)
        yield f"http://127.0.0.1:{port}"
    finally:
        service.terminate()
        service.wait(timeout=60)


def test_the_request_of_the_readme_gives_a_mesh(address: str, example: Path, repository: Path, tmp_path: Path) -> None:
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    readme = (repository / "README.md").read_text().replace("\\\n", " ")
    (request,) = re.findall(r"^curl .*$", readme, re.MULTILINE)
    mesh = tmp_path / "mesh.ply"
    command = shlex.split(
        request.replace("http://127.0.0.1:8080", address)
        .replace("mesh.ply", str(mesh))
        .replace(str(example.relative_to(repository)), str(example))
    )
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert trimesh.load_mesh(mesh).is_watertight


def test_the_example_is_three_planes(example: Path) -> None:
    drawn = np.asarray(nib.load(example).dataobj) > 0
    index = np.argwhere(drawn)
    fullest = [np.bincount(index[:, axis]).argmax() for axis in range(3)]
    assert (index == fullest).any(axis=1).all()


def test_the_demo_leaves_mesh_map_and_picture(repository: Path, tmp_path: Path) -> None:
    script = repository / "docs" / "examples" / "demo.py"
    done = subprocess.run([sys.executable, script, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert trimesh.load_mesh(tmp_path / "mesh.ply").is_watertight
    entropy = np.asarray(nib.load(tmp_path / "uncertainty.nii.gz").dataobj)
    assert 0.0 <= entropy.min() < entropy.max() <= np.log(2.0) + 1e-6
    volume = json.loads((tmp_path / "summary.json").read_text())["volume_ml"]
    assert volume["low"] < volume["value"] < volume["high"]
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
