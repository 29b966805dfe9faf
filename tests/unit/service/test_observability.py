"""Logs of faults: where in the program they arose, and nothing of what was sent."""

import io
import json
import logging
import logging.config
import traceback

import pytest

from model.errors import BundleCorrupt, InvalidMask
from service.observability import MOST_FRAMES, exception_told, make_log, uvicorn_logging

SECRET = "SMITH^JOHN"


def raised(work):
    with pytest.raises(Exception) as caught:
        work()
    return caught.value


def told(error):
    return exception_told((type(error), error, error.__traceback__))


def reads_a_folder():
    patient = SECRET
    raise ValueError(f"/uploads/{patient}.nii is no image")


def fails_while_it_reads():
    try:
        reads_a_folder()
    except ValueError as error:
        raise BundleCorrupt("weights.onnx cannot be parsed.") from error


def reads_many():
    raise ExceptionGroup(SECRET, [raised(reads_a_folder), KeyError(SECRET)])


def deep(depth):
    return reads_a_folder() if depth == 0 else deep(depth - 1)


def test_kind_function_and_file_of_the_program_are_told():
    last, first = told(raised(fails_while_it_reads))
    assert (last["exc_type"], last["exc_value"]) == ("BundleCorrupt", "weights.onnx cannot be parsed.")
    assert (first["exc_type"], "exc_value" in first) == ("ValueError", False)
    frame = first["frames"][-1]
    assert (frame["filename"], frame["name"]) == ("tests/unit/service/test_observability.py", "reads_a_folder")
    assert frame["lineno"] > 0


@pytest.mark.parametrize("work", [reads_a_folder, fails_while_it_reads, reads_many, lambda: deep(100)])
def test_nothing_of_what_was_read_is_told(work, repository):
    whole = json.dumps(told(raised(work)))
    assert SECRET not in whole
    assert str(repository) not in whole
    assert len(whole) < 20_000


def test_members_of_a_group_and_few_frames_are_told():
    assert [entry["exc_type"] for entry in told(raised(reads_many))] == ["ExceptionGroup", "ValueError", "KeyError"]
    assert len(told(raised(lambda: deep(100)))[0]["frames"]) == MOST_FRAMES


def test_a_fault_that_came_through_a_pipe_keeps_its_frames_and_no_more():
    try:
        reads_a_folder()
    except ValueError:
        text = traceback.format_exc() + f'  File "/uploads/{SECRET}.nii", line 1, in x\n'
    (entry,) = told(RuntimeError(text))
    assert [frame["name"] for frame in entry["frames"]][-2:] == ["reads_a_folder", "x"]
    assert entry["frames"][-1]["filename"] == "elsewhere"
    assert (entry["exc_type"], entry["raised"]) == ("RuntimeError", ["ValueError"])
    assert SECRET not in json.dumps(entry)


def test_logs_of_the_program_and_of_its_server_tell_the_same():
    own, served = io.StringIO(), io.StringIO()
    error = raised(reads_a_folder)
    make_log("info", own).error("fault", exc_info=error)
    logger = logging.Logger("uvicorn.error")
    (handler,) = server_handlers(served)
    logger.addHandler(handler)
    logger.error("Exception in ASGI application", exc_info=error)
    entries = [json.loads(stream.getvalue()) for stream in (own, served)]
    assert entries[0]["exception"] == entries[1]["exception"] == told(error)
    assert SECRET not in own.getvalue() + served.getvalue()


def server_handlers(stream):
    configured = logging.config.DictConfigurator(uvicorn_logging("info"))
    formatter = configured.configure_formatter(configured.config["formatters"]["json"])
    handler = logging.StreamHandler(stream)
    handler.setFormatter(formatter)
    return [handler]


def test_sentences_of_the_program_are_told():
    error = InvalidMask("The mask holds no foreground.", part="mask[0]")
    assert told(error) == [{"exc_type": "InvalidMask", "frames": [], "exc_value": "The mask holds no foreground."}]
