"""The checker behind the array annotations while tests run.

An ``int`` passes for a ``float``, as in static typing. A signature that names a protocol which only static typing
can check is left as it is; every other one is checked at each call.
"""

from collections.abc import Callable
from typing import TypeVar

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintPep3119Exception

Function = TypeVar("Function", bound=Callable[..., object])

_strict = beartype(conf=BeartypeConf(is_pep484_tower=True))


def checked(function: Function) -> Function:
    """The function with its annotations checked at each call."""
    try:
        return _strict(function)
    except BeartypeDecorHintPep3119Exception:
        return function
