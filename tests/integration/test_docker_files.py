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

from service.adapters.pacs.configuration import Listener
from service.settings import Settings

DOCKERFILES = ("service.Dockerfile", "training.Dockerfile")
#: Extras of the service image: it keeps results in a bucket and stands beside an archive where it is told to.
EXTRAS = ("cluster", "pacs")
#: Port of the listener for DICOM.
DIMSE = Listener.model_fields["port"].default


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


@pytest.mark.parametrize("name", ["compose.yaml", "compose.pacs.yaml"])
def test_compose_file_follows_the_specification(name: str, repository: Path) -> None:
    checked = tool("check-jsonschema", "--builtin-schema", "vendor.compose-spec", repository / "docker" / name)
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
    mounts = compose["services"]["service"]["volumes"]
    assert {mount.rpartition(":")[2] for mount in mounts if not mount.endswith(":ro")} == set(volumes)


def test_further_models_are_read_from_a_folder_of_this_machine(compose: dict[str, Any]) -> None:
    service = compose["services"]["service"]
    assert f"${{MODELS:-../models}}:{service['environment']['MORPHOFLOW_MODELS']}:ro" in service["volumes"]


def test_training_data_lie_where_the_dockerfile_says(repository: Path, compose: dict[str, Any]) -> None:
    assert '--volume "$PWD/data:/data:ro"' in (repository / "docker" / "training.Dockerfile").read_text()
    assert "${DATA:-../data}:/data:ro" in compose["services"]["training"]["volumes"]


def test_compose_beside_an_archive_adds_a_port_and_a_folder_that_is_only_read(repository: Path) -> None:
    overlay = yaml.safe_load((repository / "docker" / "compose.pacs.yaml").read_text())["services"]
    assert set(overlay) == {"service"}
    service = overlay["service"]
    ((name, file),) = service["environment"].items()
    assert name.removeprefix("MORPHOFLOW_").lower() in Settings.model_fields
    (mount,) = service["volumes"]
    assert mount.endswith(f":{Path(file).parent}:ro")
    (port,) = service["ports"]
    assert port.startswith("${PACS_ADDRESS:-127.0.0.1}:")
    assert port.endswith(f":{DIMSE}")
    assert str(DIMSE) in " ".join(instructions(repository / "docker" / "service.Dockerfile", "EXPOSE"))


def test_kubernetes_beside_an_archive_patches_what_is_there(repository: Path) -> None:
    folder, base = repository / "docker" / "kubernetes-pacs", repository / "docker" / "kubernetes"
    listed = yaml.safe_load((folder / "kustomization.yaml").read_text())
    added = [folder / name for name in listed["resources"] if name != "../kubernetes"]
    patches = [folder / patch["path"] for patch in listed["patches"]]
    assert {*added, *patches, folder / "kustomization.yaml"} == set(folder.iterdir())
    checked = tool("kubernetes-validate", "--strict", *added)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    known = {key for path in base.glob("*.yaml") if path.name != "kustomization.yaml" for key in objects(path)}
    assert {key for path in patches for key in objects(path)} <= known
    (file,) = objects(folder / "configuration.yaml")["ConfigMap", "morphoflow"]["data"].values()
    for kind, name in (("Deployment", "service"), ("StatefulSet", "worker")):
        pod = objects(folder / f"{'service' if name == 'service' else 'workers'}.yaml")[kind, name]["spec"]["template"]
        mounts = {mount["name"]: mount for mount in pod["spec"]["containers"][0]["volumeMounts"]}
        assert set(mounts) == {volume["name"] for volume in pod["spec"]["volumes"]}
        assert mounts["pacs"] == {"name": "pacs", "mountPath": str(Path(file).parent), "readOnly": True}
    policy = objects(folder / "archive.yaml")["NetworkPolicy", "from-archive"]["spec"]["ingress"][0]
    assert DIMSE in [entry["port"] for entry in policy["ports"]]


@pytest.mark.parametrize("file", ["service.yaml", "workers.yaml"])
def test_no_pod_is_told_of_services_by_variables_that_are_settings(file: str, repository: Path) -> None:
    """A Service that is called morphoflow would make MORPHOFLOW_PORT an address."""
    found = objects(repository / "docker" / "kubernetes" / file)
    pods = [item["spec"]["template"]["spec"] for item in found.values() if "template" in item["spec"]]
    assert pods
    assert not any(pod.get("enableServiceLinks", True) for pod in pods)


def objects(path: Path) -> dict[tuple[str, str], Any]:
    """Objects of a file for Kubernetes by kind and name."""
    found = yaml.safe_load_all(path.read_text())
    return {(item["kind"], item["metadata"]["name"]): item for item in found}


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="needs kubectl")
def test_kustomize_puts_both_together(repository: Path, tmp_path: Path) -> None:
    command = ["kubectl", "kustomize", repository / "docker" / "kubernetes-pacs"]
    made = run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    (tmp_path / "all.yaml").write_text(made.stdout)
    checked = tool("kubernetes-validate", "--strict", tmp_path / "all.yaml")
    assert checked.returncode == 0, checked.stdout + checked.stderr
    whole = objects(tmp_path / "all.yaml")
    pod = whole["Deployment", "service"]["spec"]["template"]["spec"]
    assert {"tmp", "data", "pacs", "audit"} == {volume["name"] for volume in pod["volumes"]}
    assert {"http", "dimse"} == {port["name"] for port in pod["containers"][0]["ports"]}


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
    command = [script, target, *EXTRAS]
    done = run(command, cwd=build_context, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target / "bin"


def test_image_installs_with_that_script(repository: Path) -> None:
    image = (repository / "docker" / "service.Dockerfile").read_text()
    assert f"RUN docker/install.sh /opt/morphoflow {' '.join(EXTRAS)}\n" in image


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

    def test_the_archives_side_can_be_loaded(self, installation: Path, tmp_path: Path) -> None:
        words = (installation / "python", "-c", "import service.pacs, service.jobs.pacs, service.adapters.s3")
        loaded = self.command(installation, tmp_path, *words)
        assert loaded.returncode == 0, loaded.stderr

    def test_environment_agrees_with_itself(self, installation: Path, tmp_path: Path) -> None:
        checked = self.command(installation, tmp_path, installation / "pip", "check")
        assert checked.returncode == 0, checked.stdout
