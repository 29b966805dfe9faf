"""The images without an engine: linted, checked against the specification, and installed as they install."""

import json
import os
import re
import shutil
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from subprocess import CompletedProcess, run
from typing import Any

import pytest
import yaml

DOCKERFILES = ("service.Dockerfile", "training.Dockerfile")


def tool(name: str, *arguments: str | Path) -> CompletedProcess[str]:
    return run([Path(sys.executable).with_name(name), *arguments], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def compose(repository: Path) -> dict[str, Any]:
    return yaml.safe_load((repository / "docker" / "compose.yaml").read_text())


@pytest.fixture(scope="module")
def build_context(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What .dockerignore lets through to the engine."""
    context = tmp_path_factory.mktemp("context")
    rules = (repository / ".dockerignore").read_text().splitlines()
    for name in (rule.removeprefix("!") for rule in rules if rule.startswith("!")):
        source = repository / name
        if source.is_dir():
            shutil.copytree(source, context / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif source.exists():
            shutil.copy(source, context / name)
    return context


def instructions(dockerfile: Path, name: str) -> list[str]:
    """Arguments of an instruction in the last stage."""
    joined = re.sub(r"\\\n", " ", dockerfile.read_text())
    last_stage = joined[joined.rindex("\nFROM ") :]
    return re.findall(rf"^\s*{name}\s+(.*)$", last_stage, re.MULTILINE)


@pytest.mark.parametrize("name", DOCKERFILES)
def test_dockerfile_passes_the_linter(name: str, repository: Path) -> None:
    linted = tool("hadolint", "--failure-threshold", "style", repository / "docker" / name)
    assert linted.returncode == 0, linted.stdout


@pytest.mark.parametrize("name", DOCKERFILES)
def test_image_does_not_run_as_root(name: str, repository: Path) -> None:
    (user,) = instructions(repository / "docker" / name, "USER")
    assert int(user.split(":")[0]) > 0


def test_linter_would_object(tmp_path: Path) -> None:
    bad = tmp_path / "Dockerfile"
    bad.write_text("FROM debian\nRUN cd /tmp && apt-get install python3\n")
    assert tool("hadolint", bad).returncode != 0


def test_compose_file_follows_the_specification(repository: Path) -> None:
    checked = tool(
        "check-jsonschema", "--builtin-schema", "vendor.compose-spec", repository / "docker" / "compose.yaml"
    )
    assert checked.returncode == 0, checked.stdout


@pytest.mark.parametrize("name", ["service", "training"])
def test_containers_are_confined(name: str, compose: dict[str, Any]) -> None:
    service = compose["services"][name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    assert any(mount.startswith("/tmp") for mount in service["tmpfs"])
    assert service["deploy"]["resources"]["limits"]["memory"]


def test_compose_opens_the_service_to_this_machine_alone(compose: dict[str, Any]) -> None:
    service = compose["services"]["service"]
    assert all(port.startswith("127.0.0.1:") for port in service["ports"])
    assert ":?" in service["environment"]["MORPHOFLOW_API_KEYS"], "a start without keys must be refused"


def test_writable_places_of_the_image_are_volumes(repository: Path, compose: dict[str, Any]) -> None:
    dockerfile = repository / "docker" / "service.Dockerfile"
    volumes = json.loads(*instructions(dockerfile, "VOLUME"))
    environment = " ".join(instructions(dockerfile, "ENV"))
    results = re.search(r"MORPHOFLOW_RESULTS_FOLDER=(\S+)", environment)
    assert results
    assert any(Path(results[1]).is_relative_to(volume) for volume in volumes)
    assert {mount.split(":")[1] for mount in compose["services"]["service"]["volumes"]} == set(volumes)


class Readiness(BaseHTTPRequestHandler):
    """Answers /readyz with the server's status, all else with 404."""

    def do_GET(self) -> None:
        self.send_response(self.server.status if self.path == "/readyz" else 404)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Keep quiet."""


class ReadinessServer(HTTPServer):
    status = 200


@pytest.fixture
def server() -> Iterator[ReadinessServer]:
    with ReadinessServer(("127.0.0.1", 0), Readiness) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield running
        running.shutdown()


@pytest.mark.parametrize(("status", "exit_status"), [(200, 0), (503, 1)])
def test_health_check_tells_ready_from_not_ready(
    status: int, exit_status: int, server: ReadinessServer, repository: Path
) -> None:
    server.status = status
    (check,) = instructions(repository / "docker" / "service.Dockerfile", "HEALTHCHECK")
    command = json.loads(check[check.index("[") :])
    environment = {**os.environ, "MORPHOFLOW_PORT": str(server.server_port)}
    checked = run([sys.executable, *command[1:]], env=environment, capture_output=True, check=False)
    assert checked.returncode == exit_status


@pytest.fixture(scope="module")
def installation(build_context: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Programs of an environment made by the very script that the service image runs."""
    target = tmp_path_factory.mktemp("image") / "opt"
    environment = {**os.environ, "PYTHON": sys.executable}
    script = build_context / "docker" / "install.sh"
    command = [script, target, "cluster"]
    done = run(command, cwd=build_context, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target / "bin"


def test_image_installs_with_that_script(repository: Path) -> None:
    image = (repository / "docker" / "service.Dockerfile").read_text()
    assert "RUN docker/install.sh /opt/morphoflow cluster\n" in image


@pytest.mark.slow
class TestInstalledService:
    """One installation, as in the service image; tests run outside the checkout."""

    def command(self, installation: Path, folder: Path, *arguments: str | Path) -> CompletedProcess[str]:
        environment = {"PATH": str(installation), "HOME": str(folder), "LANG": "C.UTF-8"}
        return run(arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False)

    def test_torch_is_not_there(self, installation: Path, tmp_path: Path) -> None:
        assert self.command(installation, tmp_path, installation / "python", "-c", "import torch").returncode != 0

    def test_command_line_starts(self, installation: Path, tmp_path: Path) -> None:
        shown = self.command(installation, tmp_path, installation / "morphoflow", "--help")
        assert shown.returncode == 0, shown.stderr
        assert {"serve", "reconstruct", "sample"} <= set(re.findall(r"\w+", shown.stdout))

    def test_shipped_models_are_listed(
        self, installation: Path, tmp_path: Path, shipped_bundles: tuple[Path, ...]
    ) -> None:
        listed = self.command(installation, tmp_path, installation / "morphoflow", "models", "--json")
        assert listed.returncode == 0, listed.stderr
        for bundle in shipped_bundles:
            assert json.loads((bundle / "manifest.json").read_text())["name"] in listed.stdout

    @pytest.mark.parametrize("format", ["ply", "glb", "3mf"])
    @pytest.mark.usefixtures("shipped_bundles")
    def test_a_mesh_is_made_without_torch(
        self, format: str, installation: Path, tmp_path: Path, repository: Path
    ) -> None:
        example = repository / "docs" / "examples" / "hippocampus_three_slices.nii.gz"
        target = tmp_path / f"mesh.{format}"
        words = ("--model", "hippocampus", "--uncertainty", "none")
        command = (installation / "morphoflow", "reconstruct", example, "--output", target, *words)
        made = self.command(installation, tmp_path, *command)
        assert made.returncode == 0, made.stderr
        assert target.stat().st_size > 0

    def test_environment_agrees_with_itself(self, installation: Path, tmp_path: Path) -> None:
        checked = self.command(installation, tmp_path, installation / "pip", "check")
        assert checked.returncode == 0, checked.stdout
