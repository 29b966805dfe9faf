"""In what a run that is there differs from the one that is asked for."""

from collections.abc import Mapping
from typing import Any

#: From these much else follows: the seed holds shapes out, the shapes give the extent, the steps the validations.
LEADING = ("seed", "train", "masks", "steps")

#: What is called otherwise than its key.
NAMES = {"train": "training shapes"}


def first_difference(there: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """The first of the settings and masks that differs, ``steps: 150 there, 200 asked``; empty where none does.

    Args:
        there, asked: plain values with the settings, nested or not, below ``config``.
    """
    ones, others = _flat(there), _flat(asked)
    for name in (*LEADING, *others, *ones):
        if ones.get(name) != others.get(name):
            return f"{NAMES.get(name, name)}: {_told(ones.get(name), others.get(name))}"
    return ""


def _told(one: Any, other: Any) -> str:
    """Two values side by side; of lists of masks, how many there are."""
    if not isinstance(one, list | dict) and not isinstance(other, list | dict):
        return f"{one} there, {other} asked"
    one, other = one or (), other or ()
    return f"{len(one)} there, {len(other)} asked" if len(one) != len(other) else "others are asked"


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by their path, beside what else there is."""
    found = {name: value for name, value in values.items() if name != "config"}
    return found | _leaves(values.get("config") or {})


def _leaves(values: Mapping[str, Any], head: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= _leaves(value, f"{head}{name}.") if isinstance(value, Mapping) else {head + name: value}
    return found
