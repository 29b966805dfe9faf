import inspect

import pytest

from model import errors
from model.errors import BundleError, InputError, MorphoFlowError, NotFound


def drawn() -> dict[str, str]:
    """Parent by child, read off the drawing in the module's docstring."""
    parents: dict[str, str] = {}
    above = ["MorphoFlowError"]
    for line in (errors.__doc__ or "").splitlines():
        if "── " in line:
            before, rest = line.split("── ", 1)
            depth, name = (len(before) - 4) // 4 + 1, rest.split()[0]
            parents[name] = above[depth - 1]
            above[depth:] = [name]
    return parents


def test_the_drawing_is_the_tree():
    classes = [item for _, item in inspect.getmembers(errors, inspect.isclass)]
    assert drawn() == {item.__name__: item.__base__.__name__ for item in classes if item is not MorphoFlowError}


@pytest.mark.parametrize("name", sorted(drawn()))
def test_every_error_is_caught_by_the_base_and_keeps_its_sentence(name):
    kind = getattr(errors, name)
    arguments = {"part": "mask[1]"} if issubclass(kind, InputError) else {}
    with pytest.raises(MorphoFlowError, match=r"^Zero is not accepted\.$") as caught:
        raise kind("Zero is not accepted.", **arguments)
    assert getattr(caught.value, "part", None) == arguments.get("part")


def test_an_input_error_must_name_its_part():
    with pytest.raises(TypeError):
        InputError("Zero is not accepted.")


def test_input_bundle_and_lookup_are_told_apart():
    branches = [InputError, NotFound, BundleError]
    assert not any(issubclass(a, b) for a in branches for b in branches if a is not b)
