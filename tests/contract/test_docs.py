"""Every route, part, command, option, setting and kind of problem stands in the documentation."""

from pathlib import Path

import pytest
import typer

from service.app import interface_document
from service.cli import build_app
from service.errors import KINDS, PROTOCOL_KINDS
from service.ports import MeshFormat, SampleFormat
from service.request_schemas import ReconstructionForm
from service.routes.responses import DIRECT_FORMATS, MESH_MEDIA_TYPES
from service.schemas import ResultSummary
from service.settings import SETTINGS_FILE_VARIABLE, Settings
from tests.contract.test_openapi import operations
from training.cli import register
from training.cohorts import CohortName


@pytest.fixture(scope="module")
def page(repository: Path):
    return (repository / "docs" / "service.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("method", "path"), [found[:2] for found in operations(interface_document())])
def test_routes_stand_in_the_docs(page, method, path):
    assert f"{method.upper()} {path}`" in page


def test_parameters_stand_in_the_docs(page):
    for _, _, operation in operations(interface_document()):
        for parameter in operation.get("parameters", []):
            assert f"`{parameter['name']}" in page or f"{{{parameter['name']}}}" in page
    for name in (*ReconstructionForm.model_fields, *ResultSummary.model_fields):
        assert f"`{name}`" in page


@pytest.mark.parametrize("name", [*Settings.model_fields, SETTINGS_FILE_VARIABLE.removeprefix("MORPHOFLOW_").lower()])
def test_settings_stand_in_the_docs(page, name):
    assert f"`MORPHOFLOW_{name.upper()}`" in page


@pytest.mark.parametrize(
    "name", [name for name, field in Settings.model_fields.items() if type(field.default) in (int, str)]
)
def test_documented_defaults_are_the_real_ones(page, name):
    (row,) = [line for line in page.splitlines() if line.startswith(f"| `MORPHOFLOW_{name.upper()}` |")]
    documented = row.split("|")[-2].strip().strip("`")
    assert documented == (str(Settings.model_fields[name].default) or "none")


def test_commands_and_their_options_stand_in_the_docs(page):
    group = typer.main.get_command(build_app())
    assert len(group.commands) >= 5
    for name, command in group.commands.items():
        assert f"`morphoflow {name}" in page
        for parameter in command.params:
            for option in (word for word in parameter.opts if word.startswith("--")):
                assert f"{option}`" in page or f"{option} " in page


def test_training_commands_and_their_options_stand_in_the_docs(repository):
    app = typer.Typer()
    register(app)
    text = (repository / "docs" / "training.md").read_text(encoding="utf-8")
    for name, command in typer.main.get_command(app).commands.items():
        assert f"morphoflow {name}" in text
        for parameter in command.params:
            for option in (word for word in parameter.opts if word.startswith("--")):
                assert f"{option}`" in text or f"{option} " in text, (name, option)


@pytest.mark.parametrize("name", list(CohortName))
def test_public_cohorts_stand_in_the_docs(repository, name):
    assert f"| `{name}` | `{name}/" in (repository / "docs" / "training.md").read_text(encoding="utf-8")


def test_problems_stand_in_the_docs_with_their_status(page):
    for kind in (*KINDS.values(), *PROTOCOL_KINDS.values()):
        assert f"| `{kind.type}` | {kind.status} |" in page


def test_formats_stand_in_the_docs(page):
    for format in (*MeshFormat, *SampleFormat):
        assert f"`{format.value}`" in page
    for format in DIRECT_FORMATS:
        assert f"`{MESH_MEDIA_TYPES[format]}`" in page
