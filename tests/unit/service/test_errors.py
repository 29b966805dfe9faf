"""The table from error to problem is complete and stable."""

from collections.abc import Iterator

import pytest

import service.errors as errors
from model.errors import InvalidMask, MorphoFlowError, TooLarge, UnknownModel
from service.errors import KINDS, PROTOCOL_KINDS, Overloaded, Unauthorised, kind_of


def every_error(base: type[MorphoFlowError] = MorphoFlowError) -> Iterator[type[MorphoFlowError]]:
    yield base
    for child in base.__subclasses__():
        yield from every_error(child)


def test_no_error_of_the_program_is_missing_from_the_table():
    known = {error for error in every_error() if error.__module__.split(".")[0] in ("model", "service", "training")}
    assert known - set(KINDS) == set()


@pytest.mark.parametrize("error", sorted(every_error(), key=lambda error: error.__name__))
def test_every_error_stands_in_the_drawn_trees(error):
    drawings = f"{__import__('model.errors', fromlist=['x']).__doc__}{errors.__doc__}"
    assert error.__name__ in drawings


def test_statuses_are_those_of_the_interface():
    expected = {InvalidMask: 422, TooLarge: 413, UnknownModel: 404, Overloaded: 503, Unauthorised: 401}
    assert {error: KINDS[error].status for error in expected} == expected


def test_one_name_means_one_status_and_one_title():
    kinds = [*KINDS.values(), *PROTOCOL_KINDS.values()]
    assert len({kind.name for kind in kinds}) == len(set(kinds))


def test_an_error_without_a_row_of_its_own_takes_its_parents():
    class Stranger(InvalidMask):
        pass

    try:
        assert kind_of(Stranger("It is strange.", part="mask[0]")) is KINDS[InvalidMask]
    finally:
        del Stranger
        __import__("gc").collect()
