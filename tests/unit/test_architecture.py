"""The architecture is a file that is checked; so is the claim that the checks bite."""

import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import TypeCheckError

LIGHT = ("model.errors", "model.geometry", "model.bundle", "model.inference.reconstruction", "model.inference.sampling")


def test_import_contracts_are_kept(repository: Path) -> None:
    linter = Path(sys.executable).with_name("lint-imports")
    run = subprocess.run([linter, "--no-cache"], cwd=repository, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout


def test_contracts_speak_of_every_top_package(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text())["tool"]
    shipped = project["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert set(project["importlinter"]["root_packages"]) == set(shipped)


@pytest.mark.parametrize("blocked", ["torch", "fastapi", "pydantic", "pydicom"])
def test_inference_imports_without(blocked: str, repository: Path) -> None:
    program = f"import sys; sys.modules[{blocked!r}] = None; import " + ", ".join(LIGHT)
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=repository)
    assert run.returncode == 0, run.stderr


def test_array_shapes_are_checked_at_run_time() -> None:
    pose = import_module("model.geometry").Pose()
    with pytest.raises(TypeCheckError):
        pose.to_canonical(np.zeros((5, 2)))


def test_a_whole_number_passes_for_a_float() -> None:
    assert import_module("model.geometry").Pose(log_scale=0).linear == pytest.approx(np.eye(3))
