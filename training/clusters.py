"""Whether the codes of a population lie in two clusters, by how well that describes codes that are left out.

Two Gaussians of one covariance (McLachlan and Peel 2000) are fitted by expectation maximisation, from halves along
random directions. They are believed where left-out codes are surely more probable under them than under one Gaussian.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from model.inference.clusters import Clusters

#: Codes for each dimension that are needed at least; fewer would always look as if they could be parted.
CODES_EACH = 4
#: Random halves that are started from, and steps from each.
STARTS, STEPS = 6, 150
#: Parts of the codes that are left out in turn.
FOLDS = 5
#: Clusters are believed when they gain more than so many standard errors on left-out codes.
SURE = 3.0


@dataclass(frozen=True)
class Mixture:
    """Gaussians of one covariance: one, or a mixture of two.

    Attributes:
        shares: (k,) that add up to 1.
        means, covariance: in the unit of the codes, and its square.
    """

    shares: Float[np.ndarray, "k"]
    means: Float[np.ndarray, "k d"]
    covariance: Float[np.ndarray, "d d"]

    def log_parts(self, codes: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n k"]:
        """Logarithms of each part's share of the density (nats)."""
        root = np.linalg.cholesky(self.covariance)
        white, centres = (solve_triangular(root, rows.T, lower=True) for rows in (codes, self.means))
        squares = np.square(white[:, :, None] - centres[:, None]).sum(axis=0)
        constant = np.log(np.diag(root)).sum() + 0.5 * codes.shape[1] * np.log(2.0 * np.pi)
        return np.asarray(np.log(self.shares) - 0.5 * squares - constant)

    def log_density(self, codes: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
        """Of each code (nats)."""
        return np.asarray(logsumexp(self.log_parts(codes), axis=1))

    @staticmethod
    def of(codes: Float[np.ndarray, "n d"], member: Float[np.ndarray, "n k"]) -> "Mixture":
        """The most likely one given how far each code is a member of each part."""
        sizes = member.sum(axis=0)
        means = member.T @ codes / sizes[:, None]
        inner = codes.T @ codes / len(codes) - (means.T * (sizes / len(codes))) @ means
        return Mixture(sizes / len(codes), means, inner)


def clusters_in(standard: Float[np.ndarray, "n d"], shapes: int) -> Clusters | None:
    """Two clusters of codes, or None where they are of one kind or too few to tell.

    Args:
        standard: base codes over their sigmas.
        shapes: number of training shapes; codes beyond are those of their mirror images, in the same order, and are
            left out with them.
    """
    if shapes < CODES_EACH * standard.shape[1] or not _surely_two(standard, shapes):
        return None
    found = two_parts(standard)
    towards = np.linalg.solve(found.covariance, found.means[1] - found.means[0])
    along, centre = standard @ towards, float(standard.mean(axis=0) @ towards)
    spread = float(along.std())
    low, high = ((found.means @ towards - centre) / spread).tolist()
    inner = float(np.sqrt(towards @ found.covariance @ towards)) / spread
    first, second = found.shares.tolist()
    return Clusters(towards / np.linalg.norm(towards), (first, second), (low, high), inner)


def two_parts(codes: Float[np.ndarray, "n d"]) -> Mixture:
    """The most likely mixture of two that was found."""
    stream = np.random.default_rng(0)
    found = [_from(codes, codes @ stream.standard_normal(codes.shape[1])) for _ in range(STARTS)]
    return max(found, key=lambda mixture: float(mixture.log_density(codes).sum()))


def _from(codes: Float[np.ndarray, "n d"], along: Float[np.ndarray, "n"]) -> Mixture:
    upper: Bool[np.ndarray, "n"] = along > np.median(along)
    mixture = Mixture.of(codes, np.stack([~upper, upper], axis=1).astype(float))
    for _ in range(STEPS):
        parts = mixture.log_parts(codes)
        mixture = Mixture.of(codes, np.exp(parts - logsumexp(parts, axis=1, keepdims=True)))
    return mixture


def _surely_two(codes: Float[np.ndarray, "n d"], shapes: int) -> bool:
    fold = folds(len(codes), shapes)
    gains = np.concatenate([_gain(codes[fold != left], codes[fold == left]) for left in range(FOLDS)])
    return bool(gains.mean() > SURE * gains.std(ddof=1) / np.sqrt(len(gains)))


def folds(count: int, shapes: int) -> Int[np.ndarray, "n"]:
    """In which part each code is left out; a shape and its mirror image are together."""
    return np.asarray((np.random.default_rng(0).permutation(shapes) % FOLDS)[np.arange(count) % shapes])


def _gain(seen: Float[np.ndarray, "n d"], unseen: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m"]:
    """What two clusters add to the log density of unseen codes (nats)."""
    one = Mixture.of(seen, np.ones((len(seen), 1)))
    return np.asarray(two_parts(seen).log_density(unseen) - one.log_density(unseen))
