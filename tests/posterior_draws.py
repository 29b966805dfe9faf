"""Draws from a Gaussian posterior, for laws that are about their averages."""

import numpy as np
from jaxtyping import Float


def parameter_draws(covariance: Float[np.ndarray, "p p"], pairs: int, seed: int) -> Float[np.ndarray, "c p"]:
    """Steps around the optimum in antithetic pairs: all first halves, then their opposites."""
    half = np.random.default_rng(seed).standard_normal((pairs, len(covariance)))
    values, vectors = np.linalg.eigh(covariance)
    steps = half * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    return np.concatenate([steps, -steps])
