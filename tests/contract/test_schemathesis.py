"""Generated requests against a running server: answers are those of the description, and never a fault."""

from dataclasses import dataclass
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from service.app import interface_document
from tests.contract.test_openapi import operations
from tests.service_parts import NAME, app_for, mask_parts, running

CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]


@dataclass(frozen=True)
class Interface:
    """The description of a running server, and a result that it keeps."""

    schema: Any
    result: str


@pytest.fixture(scope="module")
def interface(tmp_path_factory):
    with running(app_for(tmp_path_factory.mktemp("contract"), max_samples=2, max_voxels=120_000)) as client:
        result = client.post("/v1/reconstructions", files=mask_parts()).json()["id"]
        yield Interface(schemathesis.openapi.from_url(f"{client.base_url}/openapi.json"), result)


def rounds():
    """Right requests to every operation, and wrong ones to those that can be asked wrongly."""
    for method, path, operation in operations(interface_document()):
        if path.startswith("/dicom-web/"):
            continue  # no generator makes multipart/related; tests/integration/test_pacs_listeners.py asks them
        yield method, path, GenerationMode.POSITIVE
        kinds = [parameter["schema"].get("type") for parameter in operation.get("parameters", [])]
        if "requestBody" in operation or set(kinds) - {"string"}:
            yield method, path, GenerationMode.NEGATIVE


@pytest.mark.parametrize(("method", "path", "mode"), list(rounds()))
def test_every_operation_answers_as_described(interface, method, path, mode):
    operation = interface.schema[path][method.upper()]

    @given(case=operation.as_strategy(generation_mode=mode), known=st.booleans())
    @settings(max_examples=20, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
    def answers(case, known):
        if known and "model" in case.path_parameters:
            case.path_parameters["model"] = NAME
        if known and "id" in case.path_parameters and method == "get":
            case.path_parameters["id"] = interface.result
        case.call_and_validate(checks=CHECKS)

    answers()
