"""How well a reconstruction and the drawing agree on each plane, and what to tell about it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import expit

from model.inference.mask_stack import Plane
from model.inference.observations import Observations

#: The answer names a plane whose section is wrong by more than this share of itself and of the mean drawn section.
DISAGREEMENT_LIMIT = 0.25

#: Cross-entropies of a plane (nats mm^2) below about this much tell nothing.
LEAST_MM2 = 5.0


@dataclass(frozen=True)
class Section:
    """Observations of one plane beside the reconstruction there.

    Attributes:
        plane: which plane.
        drawn, reconstructed, shared: area (mm^2) of the drawing, of the reconstruction's section and of both.
        mean_error: mean of label minus probability.
        surprise: log ratio of the labels' cross-entropy to what it would be for labels drawn from the field.
        trusted: whether the fit used the plane.
    """

    plane: Plane
    drawn: float
    reconstructed: float
    shared: float
    mean_error: float
    surprise: float
    trusted: bool = True

    @property
    def disagreement(self) -> float:
        """``1 - Dice``."""
        total = self.drawn + self.reconstructed
        return 1.0 - 2.0 * self.shared / total if total > 0 else 0.0

    @property
    def wrong(self) -> float:
        """Area that belongs to only one of the two (mm^2)."""
        return self.drawn + self.reconstructed - 2.0 * self.shared


def sections_of(
    observations: Observations, logits: Float[np.ndarray, "n"], plane_weights: Float[np.ndarray, "k"] | None = None
) -> list[Section]:
    """Each plane that has observations beside the reconstruction, given its logits at the observations.

    Args:
        plane_weights: trust in each plane (`Fit.plane_weights`); all are trusted when None.
    """
    error = observations.labels - expit(logits.astype(float))
    found, expected = cross_entropies(logits.astype(float), observations.labels)
    drawn, inside = observations.labels * observations.weights, (logits > 0) * observations.weights
    sections = []
    for number, plane in enumerate(observations.planes):
        here = observations.plane_of == number
        if here.any():
            shared = float(inside[here] @ observations.labels[here])
            trusted = plane_weights is None or bool(plane_weights[number] > 0)
            areas = float(drawn[here].sum()), float(inside[here].sum()), shared
            weights = observations.weights[here]
            surprise = np.log((weights @ found[here] + LEAST_MM2) / (weights @ expected[here] + LEAST_MM2))
            sections.append(Section(plane, *areas, float(error[here].mean()), float(surprise), trusted))
    return sections


def cross_entropies(
    logits: Float[np.ndarray, "n"], labels: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Cross-entropy (nats) of each label, and its expectation over labels drawn from the field."""
    partition = np.logaddexp(0.0, logits)
    return partition - labels * logits, partition - expit(logits) * logits


def disagreeing_planes(sections: Sequence[Section]) -> list[Plane]:
    """Trusted planes on which much of the section, and much compared with the mean section, is wrong."""
    trusted = [section for section in sections if section.trusted]
    typical = float(np.mean([section.drawn for section in trusted])) if trusted else 0.0
    return [
        section.plane
        for section in trusted
        if section.disagreement > DISAGREEMENT_LIMIT and section.wrong > DISAGREEMENT_LIMIT * typical
    ]


def plane_warnings(sections: Sequence[Section], doubted: Plane | None = None) -> tuple[str, ...]:
    """What to tell about planes that were left out, those that the reconstruction misses, and one that stands out."""
    sentences = []
    left_out = [section.plane for section in sections if not section.trusted]
    if left_out:
        sentences.append(
            f"The drawing on {_names(left_out)} disagrees with all other planes and was left out of the fit; check it."
        )
    apart = disagreeing_planes(sections)
    if apart:
        sentences.append(f"The reconstruction disagrees with the drawing on {_names(apart)}; do not rely on it there.")
    if doubted is not None and doubted not in apart:
        sentences.append(
            f"The drawing on {_names([doubted])} agrees less with the others than they do among themselves; check it, "
            "and do not rely on the answer if it is wrong."
        )
    return tuple(sentences)


def _names(planes: Sequence[Plane]) -> str:
    return ", ".join(f"mask[{plane.stack}] axis {plane.axis} index {plane.index}" for plane in planes)
