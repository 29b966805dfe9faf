"""Content negotiation."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import NotAcceptable
from service.routes.negotiation import ANY, etags_of, negotiate

OFFERED = ("application/json", "model/stl", "model/obj")


@pytest.mark.parametrize(
    ("accept", "chosen"),
    [
        (None, "application/json"),
        ("", "application/json"),
        ("*/*", "application/json"),
        ("model/stl", "model/stl"),
        ("MODEL/STL", "model/stl"),
        ("model/*", "model/stl"),
        ("model/*;q=0.5, model/obj", "model/obj"),
        ("application/json;q=0.2, model/stl;q=0.9", "model/stl"),
        ("*/*;q=0.1, model/obj;q=0.2", "model/obj"),
        ("model/stl;q=0, model/*", "model/obj"),
        ("text/html, application/xhtml+xml, */*;q=0.8", "application/json"),
    ],
)
def test_the_client_gets_what_it_likes_best(accept, chosen):
    assert negotiate(accept, OFFERED) == chosen


@pytest.mark.parametrize("accept", ["text/html", "model/stl;q=0", "*/*;q=0", "nonsense", "model/stl;q=x"])
def test_what_cannot_be_made_is_refused_with_what_can(accept):
    with pytest.raises(NotAcceptable, match="model/stl"):
        negotiate(accept, OFFERED)


@given(st.text(max_size=60))
def test_any_header_is_answered_or_refused(accept):
    with contextlib.suppress(NotAcceptable):
        assert negotiate(accept, OFFERED) in OFFERED


@pytest.mark.parametrize(
    ("header", "matches"),
    [(None, False), ('"a"', True), ('W/"a"', True), ('"b", "a"', True), ("*", False), ('"b"', False)],
)
def test_etags_are_compared_weakly(header, matches):
    assert ('"a"' in etags_of(header)) is matches


def test_any_etag_is_none_in_particular():
    assert etags_of("*") == {ANY}
