"""The interface's description: equal to what runs, complete, and answered with what it promises."""

import re
from pathlib import Path

import pytest
import yaml

from service.app import interface_document
from service.cli import interface_yaml
from service.errors import KINDS, PROTOCOL_KINDS
from service.routes.problems import PROBLEM_MEDIA_TYPE
from tests.service_parts import app_for

METHODS = ("get", "post", "delete", "put", "patch")


def operations(document):
    return [
        (method, path, item[method]) for path, item in document["paths"].items() for method in METHODS if method in item
    ]


@pytest.fixture(scope="module")
def document():
    return interface_document()


def test_the_file_at_the_root_is_what_the_service_publishes(repository: Path, tmp_path):
    written = (repository / "openapi.yaml").read_text(encoding="utf-8")
    assert written == interface_yaml(), "write it anew: morphoflow openapi --output openapi.yaml"
    assert yaml.safe_load(written) == app_for(tmp_path).openapi()


@pytest.mark.parametrize(("path", "operation"), [found[1:] for found in operations(interface_document())])
def test_every_operation_documents_its_problems(path, operation):
    assert operation["summary"]
    answers = {int(status): answer for status, answer in operation["responses"].items()}
    assert any(status < 300 for status in answers)
    for status, answer in answers.items():
        if status == 409 and path.startswith("/dicom-web/"):
            assert set(answer["content"]) == {"application/dicom+json"}  # the store instances response tells why
        elif status >= 400:
            assert set(answer["content"]) == {PROBLEM_MEDIA_TYPE}
    if path not in ("/healthz", "/readyz"):
        assert {401, 500} <= set(answers)


def test_no_operation_promises_the_frameworks_own_error_shape(document):
    assert not {"HTTPValidationError", "ValidationError"} & set(document["components"]["schemas"])


def test_every_reference_leads_somewhere(document):
    names = re.findall(r"#/components/schemas/(\w+)", str(document))
    assert set(names) <= set(document["components"]["schemas"])
    assert "Problem" in names


def test_every_kind_of_problem_that_a_client_can_meet_is_documented(document):
    told = str(document["paths"])
    hidden = {"not-found", "method-not-allowed", "abandoned"}
    for kind in (*KINDS.values(), *PROTOCOL_KINDS.values()):
        assert kind.type in told or kind.name in hidden


def test_names_of_operations_are_unique(document):
    names = [operation["operationId"] for _, _, operation in operations(document)]
    assert len(set(names)) == len(names)


def test_every_number_with_a_unit_says_it_in_its_name(document):
    schemas = document["components"]["schemas"]
    assert {"resolution_mm", "seed"} <= set(schemas["ReconstructionForm"]["properties"])
    assert {"volume_ml", "area_cm2", "log_prior_density_nats"} <= set(schemas["ResultSummary"]["properties"])


def test_masks_are_described_as_files(document):
    form = document["components"]["schemas"]["ReconstructionForm"]
    assert form["additionalProperties"] is False
    assert form["required"] == ["mask"]
    assert form["properties"]["mask"]["items"]["type"] == "string"


def test_active_dimensions_say_of_which_variance_they_are(document):
    schemas = document["components"]["schemas"]
    names = [schemas[owner]["properties"]["active_dimensions"]["$ref"] for owner in ("ModelDescription", "ModeList")]
    of_base, of_surface = (schemas[name.rsplit("/", 1)[1]] for name in names)
    assert of_base["properties"].keys() == of_surface["properties"].keys()
    assert "base" in of_base["description"]
    assert "surface" in of_surface["description"]


def test_headers_of_answers_and_of_conditional_requests_are_declared(document):
    made = document["paths"]["/v1/reconstructions"]["post"]["responses"]
    assert set(made["200"]["headers"]) == {"Content-Location", "Link"}
    assert set(made["202"]["headers"]) == {"Location", "Preference-Applied"}
    conditional = [found for found in operations(document) if "304" in found[2]["responses"]]
    assert len(conditional) == 4
    for _, _, operation in conditional:
        assert [item["name"] for item in operation["parameters"] if item["in"] == "header"] == ["If-None-Match"]
        for status in ("200", "304"):
            assert set(operation["responses"][status]["headers"]) == {"ETag", "Cache-Control"}


def test_head_is_no_operation_of_its_own(document):
    assert not any("head" in item for item in document["paths"].values())
