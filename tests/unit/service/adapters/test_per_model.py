"""Once for each bundle, however many ask at the same time."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from service.adapters.per_model import PerModel
from tests.analytic_model import ellipsoid_model

MODELS = [replace(ellipsoid_model(), digest=str(number)) for number in range(4)]


class Counted:
    def __init__(self):
        self.calls = []

    def __call__(self, model):
        self.calls.append(model.digest)
        return object()


def test_computed_once_for_each_digest():
    counted = Counted()
    kept = PerModel(counted)
    first = [kept(model) for model in MODELS]
    again = [kept(replace(model)) for model in MODELS]
    assert first == again
    assert counted.calls == ["0", "1", "2", "3"]


def test_the_one_not_asked_for_longest_goes_first():
    counted = Counted()
    kept = PerModel(counted, kept=2)
    for number in (0, 1, 0, 2, 0, 1):
        kept(MODELS[number])
    assert counted.calls == ["0", "1", "2", "1"]


def test_threads_that_ask_together_share_one_computation():
    begun, go = threading.Event(), threading.Event()
    calls = []

    def slow(model):
        calls.append(model.digest)
        begun.set()
        assert go.wait(30.0)
        return model.digest

    kept = PerModel(slow)
    with ThreadPoolExecutor(4) as pool:
        asked = [pool.submit(kept, MODELS[0]) for _ in range(4)]
        assert begun.wait(30.0)
        go.set()
        assert [answer.result() for answer in asked] == ["0"] * 4
    assert calls == ["0"]


def test_what_failed_is_tried_again():
    answers = iter([ValueError("no"), "yes"])

    def flaky(_):
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    kept = PerModel(flaky)
    with pytest.raises(ValueError, match="no"):
        kept(MODELS[0])
    assert kept(MODELS[0]) == "yes"
