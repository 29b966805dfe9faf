"""The files for several machines, checked against their schemas, against each other and against the settings."""

import re
import sys
from pathlib import Path
from subprocess import run
from urllib.parse import urlsplit

import pytest
import yaml

from service.routes.middleware import OPEN_PATHS
from service.serving import DRAIN_S
from service.settings import Settings

LABELS = {"app.kubernetes.io/name": "morphoflow"}
#: How long (s) workers may take to end, while running requests do.
LEAVE_WITHIN_S = 30


@pytest.fixture(scope="module")
def compose(repository: Path):
    return yaml.safe_load((repository / "docker" / "compose.scale.yaml").read_text())


@pytest.fixture(scope="module")
def objects(repository: Path):
    folder = repository / "docker" / "kubernetes"
    names = yaml.safe_load((folder / "kustomization.yaml").read_text())["resources"]
    assert {*names, "kustomization.yaml"} == {path.name for path in folder.iterdir()}
    found = [item for name in names for item in yaml.safe_load_all((folder / name).read_text())]
    return {(item["kind"], item["metadata"]["name"]): item for item in found}


def test_files_follow_their_schemas(repository: Path):
    scale, folder = repository / "docker" / "compose.scale.yaml", repository / "docker" / "kubernetes"
    tools = Path(sys.executable).parent
    compose = [tools / "check-jsonschema", "--builtin-schema", "vendor.compose-spec", scale]
    manifests = [path for path in sorted(folder.glob("*.yaml")) if path.name != "kustomization.yaml"]
    for command in (compose, [tools / "kubernetes-validate", "--strict", *manifests]):
        checked = run(command, capture_output=True, text=True, check=False)
        assert checked.returncode == 0, checked.stdout + checked.stderr


def test_every_setting_is_one_of_the_service(compose, objects):
    given = set(compose["services"]["service"]["environment"]) | set(objects["ConfigMap", "morphoflow"]["data"])
    given |= {entry["name"] for entry in pod(objects["StatefulSet", "worker"])["containers"][0]["env"]}
    ours = {name.removeprefix("MORPHOFLOW_").lower() for name in given if name.startswith("MORPHOFLOW_")}
    assert ours <= set(Settings.model_fields)
    assert {"jobs_database", "storage_url", "replica"} <= ours


def test_replicas_are_confined(compose, objects):
    for name in ("service", "worker"):
        replica = compose["services"][name]
        assert replica["read_only"] is True
        assert replica["cap_drop"] == ["ALL"]
    for item in (objects["Deployment", "service"], objects["StatefulSet", "worker"]):
        (container,) = pod(item)["containers"]
        assert pod(item)["securityContext"]["runAsNonRoot"] is True
        assert container["securityContext"]["readOnlyRootFilesystem"] is True
        assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
        assert set(container["resources"]) == {"requests", "limits"}


def test_only_the_balancer_is_reached_from_outside_and_no_secret_is_written_down(compose, repository: Path):
    assert [name for name, service in compose["services"].items() if "ports" in service] == ["balancer"]
    assert all(port.startswith("127.0.0.1:") for port in compose["services"]["balancer"]["ports"])
    text = (repository / "docker" / "compose.scale.yaml").read_text()
    assert all(value.startswith("${") for value in re.findall(r"(?:PASSWORD|SECRET_ACCESS_KEY|_KEY_ID): (\S+)", text))


def test_workers_keep_their_names_and_probes_ask_what_is_meant(objects):
    worker, service = objects["StatefulSet", "worker"], objects["Deployment", "service"]
    (name,) = [entry for entry in pod(worker)["containers"][0]["env"] if entry["name"] == "MORPHOFLOW_REPLICA"]
    assert name["valueFrom"]["fieldRef"]["fieldPath"] == "metadata.name"
    (container,) = pod(service)["containers"]
    assert container["readinessProbe"]["httpGet"]["path"] == "/readyz"
    assert container["livenessProbe"]["httpGet"]["path"] == "/healthz"


def test_selectors_find_what_they_name(objects):
    for item in (objects["Deployment", "service"], objects["StatefulSet", "worker"]):
        labels = item["spec"]["template"]["metadata"]["labels"]
        assert item["spec"]["selector"]["matchLabels"] == labels
        assert labels.items() >= LABELS.items()
    for scaler in (objects["HorizontalPodAutoscaler", "service"], objects["HorizontalPodAutoscaler", "worker"]):
        target = scaler["spec"]["scaleTargetRef"]
        assert (target["kind"], target["name"]) in objects
    assert objects["NetworkPolicy", "morphoflow"]["spec"]["podSelector"]["matchLabels"] == LABELS


def pod(item):
    return item["spec"]["template"]["spec"]


def test_a_password_of_the_database_stands_in_no_address(compose):
    for name in ("service", "worker", "bucket"):
        environment = compose["services"][name]["environment"]
        assert urlsplit(environment["MORPHOFLOW_JOBS_DATABASE"]).password is None
        assert environment["PGPASSWORD"].startswith("${POSTGRES_PASSWORD")


def test_prometheus_brings_a_key_to_the_replicas(objects, repository: Path):
    (scrape,) = yaml.safe_load((repository / "docker" / "prometheus.yaml").read_text())["scrape_configs"]
    template = objects["Deployment", "service"]["spec"]["template"]
    labels = template["metadata"]["labels"]
    ports = [port["name"] for port in template["spec"]["containers"][0]["ports"]]
    kept = [rule["regex"] for rule in scrape["relabel_configs"] if rule.get("action") == "keep"]
    assert kept == [labels["app.kubernetes.io/component"], *ports]
    assert scrape["metrics_path"] not in OPEN_PATHS
    assert scrape["authorization"]["type"] == "Bearer"
    assert "annotations" not in template["metadata"]
    assert "`docker/prometheus.yaml`" in (repository / "docs" / "operations.md").read_text()


def test_a_queue_that_is_full_for_a_while_takes_no_replica_out(compose, objects, repository: Path):
    (container,) = pod(objects["Deployment", "service"])["containers"]
    probe = container["readinessProbe"]
    assert probe["periodSeconds"] * probe["failureThreshold"] >= 300
    told = " ".join((repository / "docs" / "operations.md").read_text().split())
    assert f"after {probe['failureThreshold']} failed probes, {probe['periodSeconds']} s apart" in told
    assert "httpchk GET /healthz" in compose["configs"]["balancer"]["content"]


def test_what_is_told_to_stop_has_the_time_that_it_takes(compose, objects, repository: Path):
    alone = yaml.safe_load((repository / "docker" / "compose.yaml").read_text())["services"]["service"]
    seconds = {
        "with workers": int(alone["stop_grace_period"].removesuffix("s")),
        "service": int(compose["services"]["service"]["stop_grace_period"].removesuffix("s")),
        "worker": int(compose["services"]["worker"]["stop_grace_period"].removesuffix("s")),
        "pod": pod(objects["Deployment", "service"])["terminationGracePeriodSeconds"],
    }
    assert min(seconds.values()) > max(DRAIN_S, LEAVE_WITHIN_S)
    told = (repository / "docs" / "operations.md").read_text()
    for name, file in (("with workers", "compose.yaml"), ("service", "compose.scale.yaml")):
        assert f"{seconds[name]} s in `{file}`" in told
    assert f"`terminationGracePeriodSeconds` {seconds['pod']} s" in told
