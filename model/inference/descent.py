"""Levenberg-Marquardt on latent code and pose, several problems side by side.

Each problem keeps its own damping and stops by itself; those that go on are evaluated in one batch.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag, cho_factor, cho_solve

from model.geometry import POSE_SIZE
from model.inference.fit_types import FitOptions, FitStatus
from model.inference.objective import Objective, Place, Point, evaluate

#: Up to this damping a step is close to the Gauss-Newton step.
FREE_DAMPING = 1.0
#: Damping at the start, and the one at which a problem is given up.
FIRST_DAMPING, LAST_DAMPING = 1e-2, 1e8
#: Longest step of one iteration: of the code (prior SDs), of the position (mm) and of the rotation (rad).
LONGEST_CODE_STEP, LONGEST_MOVE_MM, LONGEST_TURN = 4.0, 15.0, 0.35


@dataclass
class Descent:
    """One problem under way: the best point so far, iterations, and why it stopped (None while it goes on)."""

    objective: Objective
    point: Point
    iterations: int = 0
    status: FitStatus | None = None
    damping: float = FIRST_DAMPING
    growth: float = 2.0
    expected: float = np.inf

    def propose(self, options: FitOptions) -> Place | None:
        """Where to look next, or None when the problem has stopped."""
        if self.status is None and self.iterations >= options.max_iterations:
            self.status = FitStatus.ITERATION_LIMIT
        if self.status is not None:
            return None
        step = damped_step(self.point, self.damping)
        self.expected = -float(step @ self.point.gradient + 0.5 * step @ self.point.curvature @ step)
        place = Place(self.point.latent, self.point.pose).moved(step)
        if self.expected >= options.tolerance:
            return place
        # Behind rejected steps a step is short by its damping, not because the optimum is near.
        self.status = FitStatus.CONVERGED if self.damping <= FREE_DAMPING else FitStatus.STALLED
        if self.status is FitStatus.CONVERGED and self.expected > 0:
            # The last step is so short that it needs no look at where it leads.
            value = self.point.value - self.expected
            self.point = replace(self.point, latent=place.latent, pose=place.pose, value=value)
        return None

    def receive(self, trial: Point) -> None:
        """Take the trial point or raise the damping (Nielsen 1999)."""
        gain = (self.point.value - trial.value) / self.expected
        self.iterations += 1
        if gain > 0:
            self.point = trial
            self.damping *= max(1.0 / 5.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            self.growth = 2.0
        else:
            self.damping *= self.growth
            self.growth *= 2.0
        if self.damping > LAST_DAMPING:
            self.status = FitStatus.STALLED


#: Looks at all problems after each iteration and may stop some by giving them a status.
Referee = Callable[[Sequence[Descent]], None]


def descend(
    objectives: Sequence[Objective],
    places: Sequence[Place],
    sharpness: float,
    options: FitOptions,
    referee: Referee = lambda problems: None,
) -> list[Descent]:
    """Minimise each objective from its place; logits are multiplied by `sharpness`."""
    points = evaluate(objectives, places, sharpness)
    problems = [Descent(objective, point) for objective, point in zip(objectives, points, strict=True)]
    while True:
        proposals = [(problem, problem.propose(options)) for problem in problems]
        active = [(problem, place) for problem, place in proposals if place is not None]
        if not active:
            return problems
        trials = evaluate([problem.objective for problem, _ in active], [place for _, place in active], sharpness)
        for (problem, _), trial in zip(active, trials, strict=True):
            problem.receive(trial)
        referee(problems)


def damped_step(point: Point, damping: float) -> Float[np.ndarray, "p"]:
    """Solution of the damped normal equations, shortened so that the object moves and turns by a bounded step.

    The code is damped by its whole curvature, the pose by the diagonal of its own (Marquardt 1963): the same model in
    other latent coordinates takes the same way.
    """
    of_code, of_pose = point.curvature[:-POSE_SIZE, :-POSE_SIZE], np.diag(point.curvature)[-POSE_SIZE:]
    damped = point.curvature + damping * block_diag(of_code, np.diag(of_pose))
    step = -cho_solve(cho_factor(damped), point.gradient)
    excess = max(
        np.linalg.norm(step[:-POSE_SIZE] / point.reach) / LONGEST_CODE_STEP,
        np.linalg.norm(step[-POSE_SIZE:-4]) / LONGEST_MOVE_MM,
        np.linalg.norm(step[-4:-1]) / LONGEST_TURN,
    )
    return np.asarray(step / max(1.0, excess))
