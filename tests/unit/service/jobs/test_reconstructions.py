"""What a job of many masks keeps in its records does not grow with what was asked for, and each mask is done alike."""

import io
import json
import zipfile

import pytest

from service.jobs.reconstructions import BRIEF, reconstructions_kind
from service.jobs.worker import make_tools
from service.ports import RECONSTRUCTIONS_JOB
from tests.service_parts import app_for, mask_bytes

MASKS = 3
PLANES = [{"axis": 2, "index": index} for index in (8, 12, 16)]
CHOICES = {
    "model": None,
    "format": "ply",
    "seed": 0,
    "label": [],
    "uncertainty": "none",
    "mirror": "never",
    "resolution_mm": 4.0,
    "fidelity": None,
    "extents": "R",
}


class Run:
    """A `JobRun` that does each part at once and keeps what was recorded."""

    def __init__(self, identifier, kind):
        self.id = identifier
        self.kind = kind
        self.recorded = []

    def expect(self, total):
        self.total = total

    def spread(self, part, items, sizes=None):  # noqa: ARG002
        kept = [json.loads(json.dumps(item)) for item in items]
        self.recorded += kept
        return [self.kind.parts[part](item, lambda: None) for item in kept]


@pytest.fixture
def tools(tmp_path):
    services = app_for(tmp_path).state.services
    return make_tools(services.settings, services.registry, services.log)


def followed(tools, identifier, annotated):
    """The run of a job of some masks, and its entries."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        for number in range(MASKS):
            archive.writestr(f"{number}.nii", mask_bytes())
    files, kind = tools.files(identifier), reconstructions_kind(tools)
    files.put_input(0, target.getvalue())
    run = Run(identifier, kind)
    assert kind.follow(run, {**CHOICES, "annotated": annotated}) == {"count": MASKS}
    assert (kind.name, run.total) == (RECONSTRUCTIONS_JOB, MASKS)
    return run, [files.item(number) for number in range(MASKS)]


def test_long_choices_are_kept_once_and_not_with_each_mask(tools):
    brief, items = followed(tools, "brief", json.dumps(PLANES))
    long, same = followed(tools, "long", json.dumps(PLANES * 1000))
    assert all("file" in entry for _, entry in items)
    assert [files for files, _ in same] == [files for files, _ in items]
    sizes = [len(json.dumps(item)) for item in long.recorded[1:]]
    assert len(sizes) == MASKS
    assert max(sizes) < 100
    assert all(len(json.dumps(item)) <= BRIEF for item in brief.recorded)


def test_a_part_of_a_job_that_was_unpacked_without_a_note_holds_its_own_choices(tools):
    run, items = followed(tools, "first", "nonempty")
    files = tools.files("first")
    with pytest.raises(FileNotFoundError):
        files.note("choices")
    part = {**CHOICES, "annotated": json.dumps(PLANES * 1000), "job": "first", "number": MASKS}
    files.put_input(MASKS + 1, mask_bytes())
    files.put_note("names", {"names": [f"{number}.nii" for number in range(MASKS + 1)]})
    assert run.kind.parts["reconstruct"](part, lambda: None) == {"made": 1}
    assert files.item(MASKS)[1]["mask"] == f"{MASKS}.nii"
    assert len(items) == MASKS
