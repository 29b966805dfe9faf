"""Work in other processes gives what it gives here, ends when nobody waits, and outlives a process that dies."""

import json
import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from io import StringIO

import numpy as np
import pytest

from model.errors import InvalidParameter
from service.adapters.processes import compute_here, spread
from service.errors import HelperLost
from service.model_registry import ModelRegistry
from service.observability import make_log
from tests.analytic_model import ellipsoid_model

pytestmark = pytest.mark.slow


def open_models():
    return ModelRegistry({"ellipsoid": ellipsoid_model("ellipsoid")})


def never_opened():
    threading.Event().wait(600.0)


def where(model, *, watch, check):
    """The process that computes."""
    watch("computing")
    check()
    return os.getpid(), model.manifest.name


def meet(model, folder, *, watch, check):
    """The process that computes, once another one computes too."""
    watch("waiting")
    (folder / str(os.getpid())).touch()
    end = time.monotonic() + 60.0
    while len(list(folder.iterdir())) < 2:
        check()
        assert time.monotonic() < end
        time.sleep(0.01)
    return os.getpid(), model.manifest.name


def refuse(model, part, *, watch, check):  # noqa: ARG001
    raise InvalidParameter("It is refused.", part=part)


def stumble(model, *, watch, check):  # noqa: ARG001
    raise ZeroDivisionError


def never(model, *, watch, check):  # noqa: ARG001
    while True:
        check()
        time.sleep(0.01)


def logits(model, latent, points, *, watch, check):  # noqa: ARG001
    return model.decoder.logits(latent, points)


def unsendable(model, *, watch, check):  # noqa: ARG001
    return lambda: model


def opened_at_the_third_try(folder):
    tries = len(list(folder.iterdir()))
    (folder / str(tries)).touch()
    if tries == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    if tries == 1:
        raise MemoryError
    return open_models()


def die(model, *, watch, check):  # noqa: ARG001
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture(scope="module")
def model():
    return open_models().get("ellipsoid")


@pytest.fixture(scope="module")
def processes():
    with spread(1, open_models) as opened:
        wait_for_helper(opened)
        yield opened


def at_once(*works):
    with ThreadPoolExecutor(len(works)) as pool:
        return [future.exception() or future.result() for future in [pool.submit(work) for work in works]]


def wait_for_helper(processes, limit_s=60.0):
    end = time.monotonic() + limit_s
    while processes.free() < 2:
        assert time.monotonic() < end
        time.sleep(0.05)


def elsewhere(processes, model, work, *arguments, **more):
    """The work's outcome in the helper: this process is kept busy meanwhile."""
    busy, done = threading.Event(), threading.Event()

    def hold(model, *, watch, check):  # noqa: ARG001
        busy.set()
        done.wait(30.0)

    with ThreadPoolExecutor(1) as pool:
        held = pool.submit(processes, hold, model)
        busy.wait(30.0)
        try:
            return processes(work, model, *arguments, **more)
        finally:
            done.set()
            held.result()


def test_two_calls_at_once_are_in_two_processes_one_of_them_this(processes, model, tmp_path):
    told = []
    work = partial(processes, meet, model, tmp_path, watch=told.append)
    found = at_once(work, work)
    assert {name for _, name in found} == {"ellipsoid"}
    assert len({pid for pid, _ in found}) == 2
    assert os.getpid() in {pid for pid, _ in found}
    assert told == ["waiting", "waiting"]


def test_a_call_alone_is_computed_here(processes, model):
    assert processes(where, model)[0] == os.getpid()


def test_arrays_come_back_as_they_are_computed_here(processes, model):
    latent = np.zeros((1, model.decoder.latent_size), np.float32)
    points = np.random.default_rng(0).normal(0.0, 10.0, (1, 50, 3)).astype(np.float32)
    there = elsewhere(processes, model, logits, latent, points)
    assert np.array_equal(there, compute_here(logits, model, latent, points))


def test_an_error_of_the_program_comes_back_whole(processes, model):
    with pytest.raises(InvalidParameter, match=r"It is refused\.") as raised:
        elsewhere(processes, model, refuse, "seed")
    assert raised.value.part == "seed"


def test_a_fault_comes_back_with_where_it_arose(processes, model):
    with pytest.raises(RuntimeError, match="in stumble\n"):
        elsewhere(processes, model, stumble)


def test_what_a_check_raises_ends_the_work_and_the_helper_takes_the_next(processes, model):
    calls = iter(range(100))

    def check():
        if next(calls) > 3:
            raise TimeoutError

    with pytest.raises(TimeoutError):
        elsewhere(processes, model, never, check=check)
    assert elsewhere(processes, model, where)[0] != os.getpid()


def test_a_model_that_the_helper_does_not_have_is_computed_here(processes):
    other = ellipsoid_model("another")
    assert elsewhere(processes, other, where) == (os.getpid(), "another")


def test_a_helper_that_dies_costs_one_call_and_another_takes_its_place(processes, model):
    before = elsewhere(processes, model, where)[0]
    with pytest.raises(HelperLost):
        elsewhere(processes, model, die)
    wait_for_helper(processes)
    after = elsewhere(processes, model, where)[0]
    assert after not in (before, os.getpid())


def entries(log):
    return [json.loads(line) for line in log.getvalue().splitlines()]


def test_the_loss_of_a_helper_is_told(model):
    log = StringIO()
    with spread(1, open_models, make_log("info", log)) as opened:
        wait_for_helper(opened)
        with pytest.raises(HelperLost):
            elsewhere(opened, model, die)
    (lost,) = entries(log)
    assert (lost["event"], lost["helper"], lost["status"]) == ("helper ended and is started again", 1, -signal.SIGKILL)


def test_a_helper_that_ends_before_it_has_opened_its_models_is_followed_by_another(model, tmp_path):
    log = StringIO()
    with spread(1, partial(opened_at_the_third_try, tmp_path), make_log("info", log)) as opened:
        wait_for_helper(opened)
        assert elsewhere(opened, model, where)[0] != os.getpid()
    killed, failed = entries(log)
    assert killed["status"] == -signal.SIGKILL
    assert failed["exception"][0]["raised"] == ["MemoryError"]


def test_a_result_that_no_pipe_can_carry_is_a_fault_of_its_call_alone(processes, model):
    before = elsewhere(processes, model, where)[0]
    with pytest.raises(RuntimeError, match="pickle"):
        elsewhere(processes, model, unsendable)
    assert elsewhere(processes, model, where)[0] == before


def test_a_helper_that_died_while_nothing_was_asked_of_it_costs_nothing(processes, model):
    helper = elsewhere(processes, model, where)[0]
    os.kill(helper, signal.SIGKILL)
    os.waitid(os.P_PID, helper, os.WEXITED | os.WNOWAIT)
    assert elsewhere(processes, model, where)[0] == os.getpid()
    wait_for_helper(processes)
    assert elsewhere(processes, model, where)[0] != os.getpid()


def test_helpers_end_with_the_context():
    with spread(1, open_models) as opened:
        wait_for_helper(opened)
        helper = elsewhere(opened, open_models().get("ellipsoid"), where)[0]
    with pytest.raises(ProcessLookupError):
        os.kill(helper, 0)


def test_helpers_that_are_not_there_yet_do_not_hold_the_end_up():
    before = set(multiprocessing.active_children())
    with spread(2, never_opened) as opened:
        assert len(set(multiprocessing.active_children()) - before) == 2
        assert opened.free() == 1
    end = time.monotonic() + 10.0  # another thread may be about to note that it has seen one end
    while set(multiprocessing.active_children()) - before:
        assert time.monotonic() < end
        time.sleep(0.01)
