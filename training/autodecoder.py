"""Training of decoder, prior and one latent code a shape (auto-decoder, Park et al. 2019)."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from model.networks.decoder import OccupancyDecoder
from model.networks.prior import LatentPrior
from training.config import TrainingConfig
from training.interruption import Interruption
from training.objective import gaussian_entropy, reconstruction_loss, unevenness
from training.recorded import RecordedStep
from training.samples import Batch, PointPool, ShapePoints
from training.saved import intact, read_state

#: File of a training's state in its folder.
CHECKPOINT = "checkpoint.pt"
#: Standard deviation of the codes' noise with the denoising objective.
NOISE = 0.1
#: Shapes, and points near the contour of each, at which a step judges how even movements are.
EVEN_SHAPES, EVEN_POINTS = 32, 128
#: Called after each step with the step's number and its figures, which are read every `READ_EVERY` steps only.
Watch = Callable[[int, dict[str, float]], None]
#: Reading a figure makes the device wait, so it is not done each step.
READ_EVERY = 50


class AutoDecoder(nn.Module):
    """Decoder, prior, and a Gaussian over each training shape's code (a point when the objective is the paper's).

    With the default objective the Gaussians are held in units of the prior's sigmas. A dimension then shrinks as one,
    and the divergence, which does not depend on its sigma, leaves the choice of that to the reconstruction and ARD.

    Attributes:
        pressure: factor on `lambda_flow` and `lambda_ard` of the objective, from 0 to 1.
        isometry_pressure: factor on `lambda_isometry`, from 0 to 1.
    """

    pressure: Tensor
    isometry_pressure: Tensor

    def __init__(self, config: TrainingConfig, shapes: int) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("pressure", torch.ones(()), persistent=False)
        self.register_buffer("isometry_pressure", torch.ones(()), persistent=False)
        self.decoder = OccupancyDecoder(config.decoder)
        self.prior = LatentPrior(config.prior)
        size = config.decoder.latent_size
        unit = 1.0 if self.in_sigmas else config.prior.initial_sigma
        self.mean = nn.Parameter(0.2 * unit * torch.randn(shapes, size))
        learned = config.objective.name != "denoising"
        start = 0.3 * unit if learned else NOISE
        self.log_deviation = nn.Parameter(torch.full((shapes, size), math.log(start)), requires_grad=learned)

    @property
    def random(self) -> bool:
        """Whether codes are distributions."""
        return self.config.objective.name != "paper"

    @property
    def in_sigmas(self) -> bool:
        """Whether codes are held in units of the prior's sigmas."""
        return self.config.objective.name == "variational"

    def code_means(self) -> Float[Tensor, "m d"]:
        """Mean code of each training shape, or the code itself."""
        return self.prior.sigma * self.mean if self.in_sigmas else self.mean

    def log_deviations(self, chosen: Int[Tensor, "b"]) -> Float[Tensor, "b d"]:
        """Logarithms of the standard deviations of the chosen shapes' codes."""
        own = self.log_deviation[chosen]
        return own + self.prior.log_sigma if self.in_sigmas else own

    def draw_codes(self, chosen: Int[Tensor, "b"], generator: torch.Generator) -> Float[Tensor, "b d"]:
        """A reparameterised draw of the chosen shapes' codes, or the codes themselves."""
        mean = self.code_means()[chosen]
        if not self.random:
            return mean
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        return mean + self.log_deviations(chosen).exp() * noise

    def loss(
        self, chosen: Int[Tensor, "b"], batch: Batch, generator: torch.Generator, near: Batch | None = None
    ) -> dict[str, Tensor]:
        """The joint objective and its terms, means over the chosen shapes.

        Args:
            near: points near the contours of the first of them, for the weight on isometry.
        """
        weights = self.config.objective
        codes = self.draw_codes(chosen, generator)
        logits = self.decoder(codes, batch.points)
        rec = reconstruction_loss(weights.reconstruction, logits, batch.labels, batch.weights).mean()
        density = -self.prior.log_density(codes)
        if self.random:
            density = density - gaussian_entropy(self.log_deviations(chosen))
        ard = self.prior.ard_loss(weights.a, weights.b)
        total = rec + self.pressure * weights.lambda_flow * density.mean()
        if self.config.prior.use_ard:
            total = total + self.pressure * weights.lambda_ard * ard
        terms = {"reconstruction": rec, "prior": density.mean(), "ard": ard}
        if near is not None:
            terms["unevenness"] = self._unevenness(codes[: len(near.points)], near, generator)
            total = total + self.isometry_pressure * weights.lambda_isometry * terms["unevenness"]
        return {"loss": total, **terms}

    def _unevenness(self, codes: Float[Tensor, "b d"], near: Batch, generator: torch.Generator) -> Tensor:
        """That of movements by one random step of the prior's spread."""
        sigma = self.prior.sigma.detach()
        step = sigma * torch.randn(sigma.shape, generator=generator, device=sigma.device)
        return unevenness(*self.decoder.directional_derivative(codes, near.points, step), near.weights)


@dataclass
class Trainer:
    """One run: owns the module, the optimiser and the random stream, and can be saved and resumed exactly."""

    config: TrainingConfig
    module: AutoDecoder
    pool: PointPool
    optimiser: torch.optim.Optimizer
    generator: torch.Generator
    step: int = 0
    finished: bool = False

    def __post_init__(self) -> None:
        self._make_ready()

    @classmethod
    def start(cls, config: TrainingConfig, shapes: Sequence[ShapePoints]) -> "Trainer":
        """A fresh run, seeded."""
        device = torch.device(config.device)
        torch.manual_seed(config.seed)
        module = AutoDecoder(config, len(shapes)).to(device)
        generator = torch.Generator(device=device).manual_seed(config.seed)
        return cls(config, module, PointPool(shapes, device), _optimiser(module, config), generator)

    def advance(self, *, read: bool = True) -> dict[str, float]:
        """One optimiser step; returns its figures, or none when they are not to be read from the device."""
        self._schedule()
        if self._isometric is not self._recorded_isometry:
            self._make_ready()
        terms = self._advance_module()
        self.step += 1
        return {name: value.item() for name, value in terms.items()} if read else {}

    @property
    def _isometric(self) -> bool:
        """Whether movements are made even at this step."""
        objective = self.config.objective
        return objective.lambda_isometry > 0.0 and self.step >= objective.isometry_start * self.config.steps

    def _make_ready(self) -> None:
        self._recorded_isometry = self._isometric
        on_gpu = self.pool.device.type == "cuda"
        self._advance_module = RecordedStep(self.update, self.generator) if on_gpu else self.update

    def update(self) -> dict[str, Tensor]:
        """Draw points, descend once; the figures stay on the device and nothing waits for it."""
        config = self.config
        size = min(config.batch_shapes, self.pool.size)
        chosen = torch.randperm(self.pool.size, generator=self.generator, device=self.pool.device)[:size]
        batch = self.pool.draw(chosen, (config.near_points, config.far_points), self.generator)
        near = self.pool.draw(chosen[:EVEN_SHAPES], (EVEN_POINTS, 0), self.generator) if self._isometric else None
        terms = self.module.loss(chosen, batch, self.generator, near)
        self.optimiser.zero_grad(set_to_none=True)
        terms["loss"].backward()
        nn.utils.clip_grad_norm_(self.module.parameters(), 1.0)
        self.optimiser.step()
        return {name: value.detach() for name, value in terms.items()}

    def at_end(self) -> bool:
        """Whether the last step was made, or an earlier one was found to be the last."""
        return is_ended({"step": self.step, "finished": self.finished}, self.config)

    def _schedule(self) -> None:
        progress = self.step / self.config.steps
        ramp = self.config.objective.ramp
        self.module.pressure.fill_(min(1.0, progress / ramp) if ramp > 0 else 1.0)
        first, last = self.config.objective.isometry_start, self.config.objective.isometry_full
        self.module.isometry_pressure.fill_(min(1.0, max(0.0, progress - first) / (last - first)))
        rise = min(1.0, progress / self.config.warm_up) if self.config.warm_up > 0 else 1.0
        factor = rise * 0.5 * (1.0 + math.cos(math.pi * progress))
        for group in self.optimiser.param_groups:
            waiting = group["name"] == "flow" and progress < self.config.flow_start
            rate = 0.0 if waiting else group["full_lr"] * factor
            group["lr"] = group["lr"].fill_(rate) if isinstance(group["lr"], Tensor) else rate

    def save(self, path: Path) -> None:
        """Write a checkpoint; replaced in one move, so that a killed run leaves a whole one."""
        state = {
            "config": self.config.as_dict(),
            "step": self.step,
            "finished": self.finished,
            "module": self.module.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
        }
        part = path.with_suffix(".part")
        torch.save(state, part)
        part.replace(path)

    def load(self, path: Path) -> None:
        """Continue from a checkpoint of the same configuration; the result is that of an unbroken run.

        Raises:
            InvalidParameter: the checkpoint is damaged.
        """
        state = read_state(path, self.pool.device)
        with intact(path.name):
            self.module.load_state_dict(state["module"])
            self.optimiser.load_state_dict(state["optimiser"])
            self.generator.set_state(state["generator"].cpu())
            self.step = state["step"]
        self.finished = bool(state.get("finished", False))
        self._make_ready()


def is_ended(state: Mapping[str, Any], config: TrainingConfig) -> bool:
    """Whether a checkpoint is that of a run whose last step was made, or an earlier one was found to be the last."""
    return bool(state.get("finished", False)) or state["step"] >= config.steps


def _optimiser(module: AutoDecoder, config: TrainingConfig) -> torch.optim.Optimizer:
    """On a GPU rates are tensors, which a recorded step reads anew."""
    codes = [parameter for parameter in (module.mean, module.log_deviation) if parameter.requires_grad]
    device = module.mean.device
    on_gpu = device.type == "cuda"
    groups = [
        ("decoder", list(module.decoder.parameters()), config.learning_rate, config.weight_decay),
        ("flow", list(module.prior.flow.parameters()), config.flow_learning_rate, config.weight_decay),
        ("sigma", [module.prior.log_sigma], config.code_learning_rate, 0.0),
        ("codes", codes, config.code_learning_rate, 0.0),
    ]
    return torch.optim.AdamW(
        [
            {
                "name": name,
                "params": parameters,
                "lr": torch.tensor(rate, device=device) if on_gpu else rate,
                "full_lr": rate,
                "weight_decay": decay,
            }
            for name, parameters, rate, decay in groups
        ],
        betas=(0.9, 0.99),
        fused=True,
        capturable=on_gpu,
    )


def train(trainer: Trainer, folder: Path, watch: Watch = lambda step, figures: None) -> AutoDecoder:
    """Run to the configured number of steps with checkpoints in ``folder/checkpoint.pt``.

    Raises:
        Stopped: interrupted from the keyboard; the checkpoint holds every step that was made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with Interruption() as interruption:
        while not trainer.at_end():
            following = trainer.step + 1
            figures = trainer.advance(read=following % READ_EVERY == 0 or following == trainer.config.steps)
            watch(trainer.step, figures)
            if interruption.came or trainer.at_end() or trainer.step % trainer.config.checkpoint_every == 0:
                trainer.save(folder / CHECKPOINT)
            if not trainer.at_end():
                interruption.stop_at(trainer.step, trainer.config.steps)
    return trainer.module
