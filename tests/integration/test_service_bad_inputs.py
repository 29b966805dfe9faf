"""Every bad input through HTTP and through the command line: the status, one sentence, nothing of the header."""

import pytest

from service.cli import BAD_INPUT, main
from service.errors import KINDS
from service.model_registry import ModelRegistry
from tests.analytic_model import ellipsoid_model
from tests.bad_inputs import LIMITS, SECRET, bad_inputs
from tests.service_parts import NAME, app_for, running

BAD = pytest.mark.parametrize("bad", bad_inputs(), ids=lambda bad: bad.name)


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    with running(app_for(folder, max_body_bytes=LIMITS.max_bytes, max_voxels=LIMITS.max_voxels)) as client:
        yield client


@BAD
def test_http_answers_a_bad_input_with_its_problem(client, bad):
    parts = [("mask", (f"{SECRET}{bad.suffix}", data)) for data in bad.files()]
    answer = client.post("/v1/reconstructions", files=parts, data=bad.fields)
    assert answer.status_code == bad.status
    assert answer.headers["content-type"] == "application/problem+json"
    told = answer.json()
    if told["type"] != "urn:morphoflow:problem:too-large":
        assert told["type"] == KINDS[bad.error].type
    assert told["part"]
    assert SECRET not in answer.text
    assert len(told["detail"].split()) >= 4


@BAD
def test_the_command_line_answers_a_bad_input_in_a_sentence(bad, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MORPHOFLOW_MAX_VOXELS", str(LIMITS.max_voxels))
    monkeypatch.setenv("MORPHOFLOW_MAX_BODY_BYTES", str(LIMITS.max_bytes))
    files = []
    for number, data in enumerate(bad.files()):
        files.append(tmp_path / f"{SECRET}-{number}{bad.suffix}")
        files[-1].write_bytes(data)
    options = [word for name, value in bad.fields.items() for word in (f"--{name.replace('_', '-')}", value)]
    status = main(["reconstruct", *map(str, files), *options], lambda _: ModelRegistry({NAME: ellipsoid_model(NAME)}))
    told = capsys.readouterr()
    assert status == BAD_INPUT
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert "Traceback" not in told.err
    assert SECRET not in told.err
