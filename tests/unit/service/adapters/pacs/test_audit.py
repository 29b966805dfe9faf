"""The trail says who sent what and where results went, and shows where it was tampered with."""

import json
from multiprocessing import get_context

import pytest

from service.adapters.pacs.audit import AuditEntry, AuditEvent, AuditTrail, Outcome, TrailCheck, check_trail


def entry(number: int) -> AuditEntry:
    return AuditEntry(AuditEvent.RECEIVED, "VIEWER", "MORPHOFLOW", f"1.2.{number}", [("1.2.840", f"1.2.{number}.1")])


def write(path, count: int) -> None:
    for number in range(count):
        AuditTrail(path).write(entry(number))


def test_lines_say_who_what_and_whither(tmp_path):
    trail = AuditTrail(tmp_path / "audit.jsonl")
    trail.write(entry(7))
    trail.write(AuditEntry(AuditEvent.REFUSED, "NOBODY", "MORPHOFLOW", outcome=Outcome.SERIOUS_FAILURE, note="Why."))
    first, second = (json.loads(line)["message"] for line in (tmp_path / "audit.jsonl").read_text().splitlines())
    assert [p["UserID"] for p in first["ActiveParticipant"]] == ["VIEWER", "MORPHOFLOW"]
    assert first["EventIdentification"]["EventID"]["csd-code"] == "110104"
    assert first["ParticipantObjectIdentification"][0]["SOPClass"] == [{"UID": "1.2.840", "Instance": ["1.2.7.1"]}]
    assert second["EventIdentification"]["EventOutcomeIndicator"] == 8
    assert second["EventIdentification"]["EventOutcomeDescription"] == "Why."


def test_a_whole_trail_is_whole_and_a_changed_one_is_not(tmp_path):
    path = tmp_path / "audit.jsonl"
    write(path, 6)
    assert check_trail(path) == TrailCheck(None)
    lines = path.read_bytes().splitlines(keepends=True)
    for broken, expected in (
        ([*lines[:2], lines[2].replace(b"VIEWER", b"NOBODY"), *lines[3:]], 3),
        ([*lines[:3], *lines[4:]], 4),
        ([*lines[:1], lines[2], lines[1], *lines[3:]], 2),
        ([lines[0], b"no json\n"], 2),
        ([lines[0], b"[1]\n", *lines[1:]], 2),
        ([lines[0], lines[1][:-20] + b"\n", *lines[2:]], 3),
    ):
        path.write_bytes(b"".join(broken))
        assert check_trail(path).broken == expected


@pytest.mark.parametrize("kept", [0, 2])
@pytest.mark.parametrize("length", [1, 5, 12, 200])
def test_what_was_torn_breaks_no_later_line(tmp_path, kept, length):
    path = tmp_path / "audit.jsonl"
    write(path, kept)
    whole = path.read_bytes() if kept else b""
    write(path, 1)
    torn = path.read_bytes()[len(whole) :][:length]
    path.write_bytes(whole + torn)
    assert check_trail(path) == TrailCheck(None, (kept + 1,))
    write(path, 2)
    lines = path.read_bytes().splitlines(keepends=True)
    assert lines[kept] == torn + b"\n"
    assert check_trail(path) == TrailCheck(None, (kept + 1,))
    path.write_bytes(b"".join([*lines[:-1], lines[-1].replace(b"VIEWER", b"NOBODY")]))
    assert check_trail(path) == TrailCheck(kept + 3, (kept + 1,))
    path.write_bytes(b"".join([*lines[: kept + 1], lines[-1]]))
    assert check_trail(path) == TrailCheck(kept + 2, (kept + 1,))


def test_a_line_without_its_end_is_whole(tmp_path):
    path = tmp_path / "audit.jsonl"
    write(path, 2)
    path.write_bytes(path.read_bytes()[:-1])
    assert check_trail(path) == TrailCheck(None)
    write(path, 1)
    assert check_trail(path) == TrailCheck(None)
    assert len(path.read_bytes().splitlines()) == 3


def test_processes_write_in_turn(tmp_path):
    path = tmp_path / "audit.jsonl"
    context = get_context("spawn")
    writers = [context.Process(target=write, args=(path, 20)) for _ in range(3)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert check_trail(path) == TrailCheck(None)
    assert len(path.read_text().splitlines()) == 60


def test_the_file_is_its_owners_alone(tmp_path):
    write(tmp_path / "audit.jsonl", 1)
    assert (tmp_path / "audit.jsonl").stat().st_mode & 0o077 == 0
