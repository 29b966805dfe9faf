"""Logs of faults: where in the program they arose, and nothing of what was sent."""

import io
import json
import logging
import logging.config
import subprocess
import sys
import traceback

import pytest

from model.errors import BundleCorrupt, InvalidMask
from service.observability import (
    MOST_FRAMES,
    REPEATED_AFTER_S,
    Seldom,
    exception_told,
    going_on,
    library_logging,
    make_log,
)

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
    configured = logging.config.DictConfigurator(library_logging("info"))
    formatter = configured.configure_formatter(configured.config["formatters"]["json"])
    handler = logging.StreamHandler(stream)
    handler.setFormatter(formatter)
    return [handler]


def test_sentences_of_the_program_are_told():
    error = InvalidMask("The mask holds no foreground.", part="mask[0]")
    assert told(error) == [{"exc_type": "InvalidMask", "frames": [], "exc_value": "The mask holds no foreground."}]


PROGRAM = f"""
import logging, sys, threading, warnings
from service.observability import log_everything

log = log_everything("info")
log.info("begun")
logging.getLogger("uvicorn.error").info("The server speaks.")
logging.getLogger("uvicorn.error").error("Traceback (most recent call last):\\n  ...\\nValueError: {SECRET}")
logging.getLogger("asyncio").error("socket.accept() out of system resource\\nsocket: {SECRET}")
logging.getLogger("reader").warning("%s is odd", "{SECRET}")
warnings.warn("{SECRET} is odd")
thread = threading.Thread(target=lambda: open("/absent/{SECRET}"))
thread.start()
thread.join()
raise ValueError("{SECRET}")
"""


def test_all_that_a_program_says_is_an_entry_of_the_log_without_contents(repository):
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=repository, stderr=subprocess.PIPE, text=True, check=False
    )
    entries = [json.loads(line) for line in run.stderr.splitlines()]
    assert run.returncode == 1
    assert SECRET not in run.stderr
    assert [entry["event"] for entry in entries] == [
        "begun",
        "The server speaks.",
        "fault",
        "socket.accept() out of system resource",
        "a library has a message",
        "a library warns",
        "fault",
        "fault",
    ]
    assert [entry["exception"][0]["exc_type"] for entry in entries[-2:]] == ["FileNotFoundError", "ValueError"]


def record(text, at_s, line=1):
    made = logging.LogRecord("asyncio", logging.ERROR, __file__, line, text, None, None)
    made.created = at_s
    return made


def test_what_is_said_again_and_again_is_written_now_and_then():
    seldom = Seldom()
    times = [0.0, 1.0, REPEATED_AFTER_S - 0.1, REPEATED_AFTER_S, REPEATED_AFTER_S + 1.0]
    assert [seldom.filter(record("no descriptors\nsocket 3", at)) for at in times] == [True, False, False, True, False]
    assert seldom.filter(record("something else", times[-1]))
    assert seldom.filter(record("no descriptors\nsocket 3", times[-1], line=2))


def test_what_fails_in_one_turn_is_told_and_the_next_turn_comes():
    log, turns = io.StringIO(), []
    for turn in range(3):
        with going_on(make_log("info", log), "the turn failed"):
            turns.append(turn)
            reads_a_folder() if turn == 1 else None
    (entry,) = map(json.loads, log.getvalue().splitlines())
    assert turns == [0, 1, 2]
    assert entry["event"] == "the turn failed"
    assert entry["exception"][0]["exc_type"] == "ValueError"
