"""``python -m benchmarks.augmentation``: do synthetic shapes help where labelled ones are few?

Normal or hyperplastic adrenal glands (labels of AdrenalMNIST3D) are told apart by logistic regression on measures of
the surface: volume, extents along 64 directions, spread along the principal axes. Of the training masks a share keeps
its labels. Decoder and flow were trained on all training masks without labels: labels are scarce here, shapes are not.
For each class a Gaussian on the base codes of the share's own shapes makes synthetic ones, decoded to surfaces and
measured like the others. Held-out masks are classified with and without them, over several seeds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import rankdata, t

from benchmarks.generator.density import GaussianPrior
from benchmarks.generator.surfaces import Surface, decoded, surface_of_mask
from model.bundle import ShapeModel
from training.cohort_options import DataOption
from training.cohorts import CohortName, CohortOptions, data_folder, load_cohort
from training.cohorts.adrenal import ARCHIVE
from training.cohorts.cohort import Case
from training.console import exit_status
from training.evaluate import open_named

SHARES = (0.05, 0.10, 0.25)
#: Weight of the squared coefficients against the mean loss.
RIDGE = 0.02
#: Dimensions of a smaller sigma, against the largest, are left at zero.
LEAST_SIGMA = 0.01


@dataclass(frozen=True)
class Labelled:
    """Measures of surfaces and whether each is hyperplastic."""

    measures: Float[np.ndarray, "n k"]
    positive: Bool[np.ndarray, "n"]

    def joined(self, other: "Labelled") -> "Labelled":
        """Both."""
        measures = np.concatenate([self.measures, other.measures])
        return Labelled(measures, np.concatenate([self.positive, other.positive]))


def main(
    model: Annotated[str, typer.Option(help="Bundle trained on the adrenal cohort.")],
    seeds: Annotated[int, typer.Option(min=2, help="Repetitions, each with a share of its own.")] = 10,
    synthetic: Annotated[int, typer.Option(min=2, help="Synthetic shapes of each class.")] = 100,
    spacing_mm: Annotated[float, typer.Option(help="Grid step of synthetic surfaces (mm).")] = 2.0,
    data: DataOption = None,
) -> None:
    """Measure and print a table."""
    with exit_status():
        opened = open_named(model)
        folder = data_folder(data)
        cohort = load_cohort(CohortName.ADRENAL, folder, CohortOptions(skip_refused=True))
        train = labelled(cohort.train, folder)
        held_out = labelled(cohort.validation, folder)
        lines = ["| labelled share | shapes | AUC without | AUC with synthetic | difference (95 % interval) |"]
        lines += ["| --- | --- | --- | --- | --- |"]
        for share in SHARES:
            pairs = np.array([compared(opened, train, held_out, share, n, synthetic, spacing_mm) for n in range(seeds)])
            lines.append(_line(share, round(share * len(train.positive)), pairs))
        typer.echo("\n".join(lines))


def labelled(cases: Sequence[Case], folder: Path) -> Labelled:
    """Measures and labels of adrenal masks."""
    with np.load(folder / "adrenal" / ARCHIVE) as archive:
        labels = {"train": archive["train_labels"].ravel(), "test": archive["val_labels"].ravel()}
    where = [case.name.rsplit("_", 2)[1:] for case in cases]
    positive = np.array([bool(labels[array][int(number)]) for array, number in where])
    return Labelled(np.stack([measures_of(surface_of_mask(case)) for case in cases]), positive)


def measures_of(surface: Surface) -> Float[np.ndarray, "k"]:
    """Logarithms of volume, of extents along directions, and of the spread of the points along principal axes."""
    spread = np.linalg.svd(surface.points - surface.points.mean(axis=0), compute_uv=False)
    sizes = np.concatenate([[surface.volume_ml], surface.support, spread / np.sqrt(len(surface.points))])
    return np.asarray(np.log(np.maximum(sizes, 1e-3)))


def compared(
    model: ShapeModel, train: Labelled, held_out: Labelled, share: float, seed: int, count: int, spacing_mm: float
) -> tuple[float, float]:
    """Areas under the curve without and with synthetic shapes, for one share of the training shapes."""
    chosen = stratified(train.positive, share, seed)
    few = Labelled(train.measures[chosen], train.positive[chosen])
    parts = [synthetic_of(model, chosen[few.positive == kind], bool(kind), count, seed, spacing_mm) for kind in (0, 1)]
    more = few.joined(parts[0]).joined(parts[1])
    # Synthetic shapes count together as much as the real ones of their class.
    weights = np.concatenate([np.ones(len(chosen)), *(_weights(few, part) for part in parts)])
    plain = area_under_curve(score(few, np.ones(len(chosen)), few, held_out), held_out.positive)
    return plain, area_under_curve(score(more, weights, few, held_out), held_out.positive)


def stratified(positive: Bool[np.ndarray, "n"], share: float, seed: int) -> Int[np.ndarray, "m"]:
    """Numbers of a share of each class, at least three."""
    random = np.random.default_rng((seed, 7))
    parts = [np.flatnonzero(positive == kind) for kind in (False, True)]
    return np.concatenate([random.permutation(part)[: max(3, round(share * len(part)))] for part in parts])


def synthetic_of(
    model: ShapeModel, chosen: Int[np.ndarray, "m"], kind: bool, count: int, seed: int, spacing_mm: float
) -> Labelled:
    """Synthetic shapes of a class, from a Gaussian on its base codes."""
    sigmas = np.asarray(model.manifest.sigmas)
    live = np.flatnonzero(sigmas >= LEAST_SIGMA * sigmas.max())
    prior = GaussianPrior.of((model.population.base_codes[chosen] / sigmas)[:, live].astype(float))
    base = np.zeros((count, len(sigmas)))
    base[:, live] = prior.draw(count, seed) * sigmas[live]
    surfaces = [decoded(model, code, spacing_mm) for code in model.prior.from_base(base)]
    measures = np.stack([measures_of(surface) for surface in surfaces if surface is not None])
    return Labelled(measures, np.full(len(measures), kind))


def score(
    known: Labelled, weights: Float[np.ndarray, "n"], real: Labelled, unknown: Labelled
) -> Float[np.ndarray, "m"]:
    """Log odds of held-out shapes by weighted logistic regression; measures in units of the real training shapes."""
    centre, scale = real.measures.mean(axis=0), real.measures.std(axis=0) + 1e-6
    x = np.column_stack([(known.measures - centre) / scale, np.ones(len(known.positive))])
    signs = np.where(known.positive, 1.0, -1.0)
    balance = weights / np.where(known.positive, weights[known.positive].sum(), weights[~known.positive].sum()) / 2.0

    def loss(w: Float[np.ndarray, "k"]) -> tuple[float, Float[np.ndarray, "k"]]:
        margins = signs * (x @ w)
        slope = -balance * signs * expit(-margins)
        penalty = np.append(w[:-1], 0.0)
        value = float(balance @ np.logaddexp(0.0, -margins) + RIDGE * (penalty @ penalty))
        return value, x.T @ slope + 2.0 * RIDGE * penalty

    found = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x
    return np.asarray(np.column_stack([(unknown.measures - centre) / scale, np.ones(len(unknown.positive))]) @ found)


def area_under_curve(scores: Float[np.ndarray, "n"], positive: Bool[np.ndarray, "n"]) -> float:
    """Chance that a positive shape scores above a negative one (Mann and Whitney)."""
    ranks, count = rankdata(scores), int(positive.sum())
    return float((ranks[positive].sum() - count * (count + 1) / 2) / (count * (len(positive) - count)))


def _weights(few: Labelled, part: Labelled) -> Float[np.ndarray, "m"]:
    same = int((few.positive == part.positive[0]).sum())
    return np.full(len(part.positive), same / len(part.positive))


def _line(share: float, count: int, pairs: Float[np.ndarray, "s 2"]) -> str:
    gain = pairs[:, 1] - pairs[:, 0]
    reach = float(t.ppf(0.975, len(gain) - 1) * gain.std(ddof=1) / np.sqrt(len(gain)))
    mean = float(gain.mean())
    plain, augmented = pairs.mean(axis=0)
    return (
        f"| {share:.0%} | {count} | {plain:.3f} | {augmented:.3f} | "
        f"{mean:+.3f} ({mean - reach:+.3f} to {mean + reach:+.3f}) |"
    )


if __name__ == "__main__":
    typer.run(main)
