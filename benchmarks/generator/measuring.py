"""What is measured of a generator; every figure with its definition."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from scipy.stats import ks_2samp

from benchmarks.generator.density import FittedCase, GaussianPrior, fitted, log_densities
from benchmarks.generator.principal import drawn, principal_modes, projected
from benchmarks.generator.surfaces import Surface, decoded, distance_mm, nearest_mm, surface_of_mask
from benchmarks.generator.table import Figure
from model.bundle import ShapeModel
from model.inference.clusters import clusters_of, drawn_base
from model.inference.modes import shape_modes
from model.inference.sampling import draw_shape
from training.cohorts.cohort import Case, Cohort
from training.generation import generated


@dataclass(frozen=True)
class Plan:
    """How much is measured.

    Attributes:
        samples: draws of the prior.
        compared: of these, how many are compared with the whole population, and draws of each other generator.
        fitted: training and held-out masks that are fitted, each at most.
        timed: draws at the model's own resolution that are timed.
        spacing_mm: grid step of compared surfaces.
    """

    samples: int
    compared: int
    fitted: int
    timed: int
    spacing_mm: float
    seed: int = 0


#: Surfaces of draws of the prior, none rejected for what it is; None where there is none.
Draws = Sequence[Surface | None]


def measured(model: ShapeModel, cohort: Cohort, held_out: Sequence[Case], plan: Plan) -> Iterator[list[Figure]]:
    """All figures, part by part."""
    draws = draw_all(model, plan)
    present = [surface for surface in draws if surface is not None]
    training = [decoded(model, code, plan.spacing_mm) for code in model.population.codes]
    masks = [surface_of_mask(case, mirrored=m) for case in cohort.train for m in _images(cohort)]
    modes = shape_modes(model)
    active = modes.active()
    yield _compactness(model, active)
    yield _distributions(model, draws, [surface for surface in training if surface is not None])
    yield _paper_protocol(model, plan)
    some = _some(cohort.train, plan.fitted, plan.seed)
    trained = [fitted(model, case, plan.spacing_mm) for case in some]
    unseen = [fitted(model, case, plan.spacing_mm) for case in held_out[: plan.fitted]]
    yield _density(model, trained, unseen)
    yield _against_principal(model, cohort, held_out[: plan.fitted], unseen, present, masks, active[-1], plan)
    yield _membership(cohort, present, masks, training, held_out, plan)
    yield _speed(model, plan)


def draw_all(model: ShapeModel, plan: Plan) -> Draws:
    """Draws of consecutive seeds as the service makes them; none is rejected for its surface."""
    sigmas, clusters = np.asarray(model.manifest.sigmas), clusters_of(model.manifest)
    base = [drawn_base(sigmas, clusters, np.random.default_rng(seed))[0] for seed in range(plan.samples)]
    return [decoded(model, model.prior.from_base(row[None])[0], plan.spacing_mm) for row in base]


def _compactness(model: ShapeModel, active: tuple[int, int, int]) -> list[Figure]:
    pruned = model.manifest.training.get("pruned")
    size = int(pruned["dimensions_before"]) if isinstance(pruned, Mapping) else model.manifest.latent_size
    counts = [
        Figure(f"dimensions for {share} % of the surface's variance", float(n))
        for share, n in zip((95, 97, 99), active, strict=True)
    ]
    return [
        *counts,
        Figure(f"share of {size} trained dimensions beyond 99 %", 1.0 - active[-1] / size, limit=0.35, at_most=False),
    ]


def _distributions(model: ShapeModel, draws: Draws, training: Sequence[Surface]) -> list[Figure]:
    present = [surface for surface in draws if surface is not None]
    volumes = ks_2samp([s.volume_ml for s in present], [s.volume_ml for s in training])
    masks = ks_2samp([s.volume_ml for s in present], model.population.volumes_ml)
    areas = ks_2samp([s.area_cm2 for s in present], [s.area_cm2 for s in training])
    whole = sum(surface.parts == 1 for surface in present) / len(draws)
    return [
        Figure("volume: two-sample KS p", float(volumes.pvalue), "training codes' surfaces", limit=0.05, at_most=False),
        Figure("volume: the same against the masks", float(masks.pvalue), "coarse surfaces are smaller"),
        Figure("area: two-sample KS p", float(areas.pvalue), "training codes' surfaces", limit=0.05, at_most=False),
        Figure("share of draws in one component", whole, limit=0.98, at_most=False),
    ]


def _paper_protocol(model: ShapeModel, plan: Plan) -> list[Figure]:
    """Distance in z0 to the nearest training code against the distance between the surfaces, see `generated`."""
    found = generated(model, samples=plan.samples, seed=plan.seed)
    return [
        Figure("z0 distance against surface distance: Pearson r", found.pearson, limit=0.85, at_most=False),
        Figure("the same: R^2", found.r_squared),
    ]


def _density(model: ShapeModel, trained: Sequence[FittedCase], unseen: Sequence[FittedCase]) -> list[Figure]:
    size = model.manifest.latent_size
    inside, outside = log_densities(model, trained), log_densities(model, unseen)
    gaussian = GaussianPrior.of(np.asarray(model.population.codes, float))
    codes = np.stack([case.latent for case in unseen])
    gap = float(inside.mean() - outside.mean()) / size
    return [
        Figure("training minus held-out log density (nats a dimension)", gap, "both fitted to dense masks", limit=0.15),
        Figure("held-out log density (nats a dimension)", float(outside.mean()) / size),
        Figure("the same under a Gaussian on the codes", float(gaussian.log_density(codes).mean()) / size),
    ]


def _against_principal(
    model: ShapeModel,
    cohort: Cohort,
    held_out: Sequence[Case],
    unseen: Sequence[FittedCase],
    draws: Sequence[Surface],
    masks: Sequence[Surface],
    count: int,
    plan: Plan,
) -> list[Figure]:
    """Generalisation: held-out masks to their description. Specificity: draws to the nearest training mask (mm)."""
    modes = principal_modes(cohort.train, count)
    count = modes.modes.shape[1]
    truths = [surface_of_mask(case) for case in held_out]
    ours = float(np.mean([distance_mm(case.surface, truth) for case, truth in zip(unseen, truths, strict=True)]))
    described = [projected(modes, case) for case in held_out]
    theirs = float(np.mean([distance_mm(s, t) for s, t in zip(described, truths, strict=True) if s is not None]))
    gaussian = GaussianPrior.of(np.asarray(model.population.codes, float)).draw(plan.compared, plan.seed)
    others = {
        "model": draws[: plan.compared],
        "principal": drawn(modes, plan.compared, plan.seed),
        "gaussian": [s for code in gaussian if (s := decoded(model, code, plan.spacing_mm)) is not None],
    }
    specific = {name: float(np.mean([nearest_mm(s, masks) for s in found])) for name, found in others.items()}
    note = f"PCA of signed distances, {count} modes"
    return [
        Figure("generalisation (mm)", ours, note + f": {theirs:.3f}", limit=theirs),
        Figure(
            "specificity (mm)", specific["model"], note + f": {specific['principal']:.3f}", limit=specific["principal"]
        ),
        Figure("specificity of a Gaussian on the codes (mm)", specific["gaussian"]),
    ]


def _membership(
    cohort: Cohort,
    draws: Sequence[Surface],
    masks: Sequence[Surface],
    training: Sequence[Surface | None],
    held_out: Sequence[Case],
    plan: Plan,
) -> list[Figure]:
    """Distance to the nearest training mask; copies would lie as near as training codes to their own masks."""
    images = len(_images(cohort))
    chosen = [i * images for i in _spread(len(masks) // images, plan.fitted)]
    known = [nearest_mm(masks[i], masks, leave_out=range(i, i + images)) for i in chosen]
    unseen = [nearest_mm(surface_of_mask(case), masks) for case in held_out]
    made = [nearest_mm(surface, masks) for surface in draws[: plan.compared]]
    own = [nearest_mm(s, masks) for i in _spread(len(training), plan.fitted) if (s := training[i]) is not None]
    copies = float(np.mean(np.array(made) <= np.quantile(own, 0.95)))
    return [
        Figure("nearest training mask of draws (mm, median)", median(made)),
        Figure("of training codes, their own included", median(own)),
        Figure("of held-out masks", median(unseen)),
        Figure("of training masks, themselves left out", median(known)),
        Figure("share of draws as near as 95 % of training codes to their own", copies),
    ]


def _speed(model: ShapeModel, plan: Plan) -> list[Figure]:
    """Processor time of draws at the model's own resolution, as the service makes them."""
    draw_shape(model, 0)
    start = time.process_time()
    shapes = [draw_shape(model, seed) for seed in range(plan.timed)]
    each = (time.process_time() - start) / plan.timed
    rejected = sum(sum(shape.rejected.values()) for shape in shapes)
    return [
        Figure("meshes a second on two cores", 2.0 / each, "by processor time", limit=12.0, at_most=False),
        Figure("draws rejected for each one kept", rejected / plan.timed),
    ]


def _images(cohort: Cohort) -> tuple[bool, ...]:
    return (False, True) if cohort.reflects else (False,)


def _spread(size: int, count: int) -> list[int]:
    """At most so many numbers below a size, evenly apart."""
    return sorted({int(i) for i in np.linspace(0, size - 1, min(count, size))})


def _some(cases: Sequence[Case], count: int, seed: int) -> list[Case]:
    order = np.random.default_rng(seed).permutation(len(cases))[:count]
    return [cases[int(i)] for i in order]
