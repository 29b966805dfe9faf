"""Whether the values of a manifest can be what they say they are, so that no request meets what they cannot be."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from model.errors import BundleCorrupt

#: What must be there of each group of figures that is not empty.
GROUPS = {
    "discrepancy": ("spread_mm", "fidelity"),
    "usual": ("misfit_mm", "misfit_exponent", "surface_sd_mm", "surface_sd_exponent"),
    "posterior": ("sd_scale", "offset_mm"),
    "typical": (
        "freedom", "density_peak", "rarity_mean", "rarity_sd", "misfit_mean", "misfit_sd", "misfit_exponent",
        "slice_mean", "slice_sd",
    ),
}  # fmt: skip
#: What need not be there, but is a positive number where it is.
OPTIONAL = {"posterior": ("sharpness",)}
SIDES = ("left", "right", "mixed", "unpaired")


def check_values(values: Mapping[str, Any]) -> None:
    """Refuse values of another kind or out of their range.

    Args:
        values: of a manifest, by the names of `model.bundle.Manifest`.

    Raises:
        BundleCorrupt: names the first that cannot be and says what is accepted.
    """
    for name, is_right, accepted in _RULES:
        if name in values and not is_right(values[name]):
            raise BundleCorrupt(f"{name} of the manifest is {_shown(values[name])}; {accepted} accepted.")
    if len(values["sigmas"]) != values["latent_size"]:
        raise BundleCorrupt(
            f"sigmas of the manifest are {len(values['sigmas'])}; one for each of the {values['latent_size']} "
            "dimensions of latent_size is accepted."
        )
    _check_clusters(values.get("clusters", {}), values["latent_size"])
    _check_completion(values.get("completion", {}))
    for name, keys in GROUPS.items():
        group = values.get(name, {})
        if not isinstance(group, Mapping):
            raise BundleCorrupt(f"{name} of the manifest is {_shown(group)}; figures by name are accepted.")
        wrong = [key for key in keys if not _is_number(group.get(key))] if group else []
        wrong += [key for key in OPTIONAL.get(name, ()) if key in group and not _is_positive(group[key])]
        if wrong:
            raise BundleCorrupt(
                f"{name} of the manifest lacks a number for {', '.join(wrong)}; calibrate the model anew."
            )


def _check_clusters(clusters: object, latent_size: int) -> None:
    if clusters == {}:
        return
    rules = {"direction": _all(latent_size, _is_number), "shares": _all(2, _is_positive), "means": _all(2, _is_number)}
    known = clusters if isinstance(clusters, Mapping) else {}
    wrong = [name for name, rule in {**rules, "sd": _is_positive}.items() if not rule(known.get(name))]
    if wrong:
        raise BundleCorrupt(
            f"clusters of the manifest lack {', '.join(wrong)}; a direction of {latent_size} numbers, two shares, two "
            "means and an sd are accepted."
        )


def _check_completion(completion: object) -> None:
    """The lattice is checked where the network is opened."""
    share = completion.get("share", 0.0) if isinstance(completion, Mapping) else None
    if not (isinstance(share, int | float) and _is_number(share) and 0.0 <= share <= 1.0):
        raise BundleCorrupt(
            f"completion of the manifest has a share {_shown(share)}; a number from 0 to 1 is accepted, calibrate the "
            "model anew."
        )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and _is_number(value) and value > 0


def _is_count(value: object) -> bool:
    return isinstance(value, int) and _is_positive(value)


def _all(length: int | None, is_right: Callable[[object], bool]) -> Callable[[object], bool]:
    def check(value: object) -> bool:
        if not isinstance(value, Sequence) or isinstance(value, str) or length not in (None, len(value)):
            return False
        return len(value) > 0 and all(is_right(one) for one in value)

    return check


def _are_figures(value: object) -> bool:
    """Numbers by name, by regime."""
    if not isinstance(value, Mapping) or not all(isinstance(group, Mapping) for group in value.values()):
        return False
    return all(_is_number(figure) for group in value.values() for figure in group.values())


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_record(value: object) -> bool:
    return isinstance(value, Mapping)


def _is_code(value: object) -> bool:
    names = ("value", "scheme", "meaning")
    return value == {} or (isinstance(value, Mapping) and all(_is_text(value.get(name)) for name in names))


def _one_of(*known: str) -> Callable[[object], bool]:
    return lambda value: value in known


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


#: Name, what it has to be, and the same in words.
_RULES: tuple[tuple[str, Callable[[object], bool], str], ...] = (
    ("frame", _one_of("RAS"), "RAS is"),
    ("units", _one_of("mm"), "mm is"),
    ("side", _one_of(*SIDES), f"{', '.join(SIDES)} are"),
    ("latent_size", _is_count, "a whole number from 1 is"),
    ("sigmas", _all(None, _is_positive), "positive numbers are"),
    ("half_extent_mm", _all(3, _is_positive), "three positive numbers are"),
    ("resolution_mm", _is_positive, "a positive number is"),
    ("likelihood_precision", _is_positive, "a positive number is"),
    ("active_dimensions", _all(3, _is_count), "three whole numbers from 1 are"),
    *((name, _is_text, "a text is") for name in ("structure", "licence", "attribution")),
    *((name, _is_record, "an object is") for name in ("training", "calibration")),
    ("anatomy", _is_code, "an object with value, scheme and meaning, or an empty one, is"),
    ("accuracy", _are_figures, "finite numbers by regime and name are"),
)
