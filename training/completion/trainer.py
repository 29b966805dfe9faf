"""Training of a completion network: random drawings in, dense masks out; resumes where it was left."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from model.errors import InvalidParameter
from model.geometry import CanonicalLattice
from model.networks.completion import CompletionNet, CompletionShape
from training.completion.samples import Sample, random_sample
from training.difference import first_difference
from training.interruption import Interruption
from training.points import Window
from training.saved import intact, read_state

CHECKPOINT = "completion.pt"
#: Optimiser steps unless a caller says otherwise.
STEPS = 10_000
#: The learning rate rises over so many steps, or this share of them where that is less; steps between checkpoints.
RISE, RISE_SHARE, SAVED_EVERY = 100, 0.05, 100
#: Gradients longer than this are shortened.
LONGEST_GRADIENT = 1.0

#: Called after each step with its number and the loss.
Watch = Callable[[int, float], None]


@dataclass(frozen=True)
class CompletionConfig:
    """Settings of a training.

    Attributes:
        voxels, step_mm: the lattice.
        width: channels of the network's finest level.
        steps, batch: optimiser steps, and samples of each.
        learning_rate, weight_decay: of AdamW; the rate falls to zero along a cosine.
        reflected: every other sample is mirrored.
        seed: of the network and the samples.
    """

    voxels: tuple[int, int, int]
    step_mm: float
    width: int = 24
    steps: int = STEPS
    batch: int = 4
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    reflected: bool = False
    seed: int = 0

    @property
    def lattice(self) -> CanonicalLattice:
        """Where the network works."""
        return CanonicalLattice(self.voxels, self.step_mm)


def train_completion(
    windows: Sequence[Window],
    config: CompletionConfig,
    folder: Path,
    *,
    masks: Sequence[str] = (),
    device: str = "cpu",
    half: bool | None = None,
    watch: Watch = lambda step, loss: None,
) -> CompletionNet:
    """Train to the end, from the folder's checkpoint where there is one.

    Args:
        masks: digests of the masks, by which a checkpoint is known to be of the same ones.
        half: whether the network computes in bfloat16 while it learns; where the device does so in matrix units, when
            None.

    Raises:
        InvalidParameter: the checkpoint is of other masks or settings, or damaged.
        Stopped: interrupted from the keyboard; the checkpoint holds every step that was made.
    """
    made_of = {"config": asdict(config), "masks": list(masks)}
    half = _has_matrix_units(device) if half is None else half
    torch.manual_seed(config.seed)
    net = CompletionNet(CompletionShape(config.voxels, config.width)).to(device)
    optimiser = torch.optim.AdamW(net.parameters(), config.learning_rate, weight_decay=config.weight_decay)
    begin = _resumed(net, optimiser, made_of, folder / CHECKPOINT)
    folder.mkdir(parents=True, exist_ok=True)
    with Interruption() as interruption, ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for step in range(begin, config.steps):
            for group in optimiser.param_groups:
                group["lr"] = config.learning_rate * _share(step, config.steps)
            batch = _batch(windows, config, step, pool)
            drawn, inside, known = (part.to(device) for part in batch)
            with torch.autocast(device, torch.bfloat16, enabled=half):
                logits = net(drawn)
            loss = completion_loss(logits.float(), inside, known)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), LONGEST_GRADIENT)
            optimiser.step()
            watch(step + 1, loss.item())
            if interruption.came or (step + 1) % SAVED_EVERY == 0 or step + 1 == config.steps:
                _save(net, optimiser, made_of, step + 1, folder / CHECKPOINT)
            interruption.stop_at(step + 1, config.steps)
    return net.cpu().eval()


def completion_loss(
    logits: Float[Tensor, "b i j k"], inside: Float[Tensor, "b i j k"], known: Float[Tensor, "b i j k"]
) -> Tensor:
    """Cross-entropy in units of the object's volume, and soft Dice, over known voxels; mean over the batch."""
    axes = (1, 2, 3)
    volume = (inside * known).sum(axes).clamp(min=1.0)
    entropy = (functional.binary_cross_entropy_with_logits(logits, inside, reduction="none") * known).sum(axes) / volume
    found = torch.sigmoid(logits) * known
    dice = 2.0 * (found * inside).sum(axes) / (found.sum(axes) + volume)
    return (entropy + 1.0 - dice).mean()


def _batch(
    windows: Sequence[Window], config: CompletionConfig, step: int, pool: ThreadPoolExecutor
) -> tuple[Tensor, Tensor, Tensor]:
    """Samples of a step: a function of the seed and the step's number."""

    def sample(rng: np.random.Generator) -> Sample:
        mirrored = config.reflected and bool(rng.random() < 0.5)
        return random_sample(windows[int(rng.integers(len(windows)))], config.lattice, rng, mirrored=mirrored)

    made = list(pool.map(sample, np.random.default_rng([config.seed, step]).spawn(config.batch)))
    drawn, inside, known = (
        torch.from_numpy(np.stack([getattr(one, name) for one in made]).astype(np.float32))
        for name in ("drawn", "inside", "known")
    )
    return drawn, inside, known


def _has_matrix_units(device: str) -> bool:
    """Whether products of bfloat16 are several times as fast as those of single precision."""
    return device != "cpu" or bool(torch.cpu.get_capabilities().get("amx_bf16", False))


def _share(step: int, steps: int) -> float:
    """Of the learning rate: a rise, then a cosine."""
    risen = min(1.0, (step + 1) / max(1.0, min(RISE, RISE_SHARE * steps)))
    return risen * 0.5 * (1.0 + float(np.cos(np.pi * step / steps)))


def _resumed(net: CompletionNet, optimiser: torch.optim.Optimizer, made_of: Mapping[str, Any], path: Path) -> int:
    """Steps that were done already."""
    if not path.is_file():
        return 0
    state = read_state(path, "cpu")
    found = first_difference({name: state.get(name) for name in made_of}, made_of)
    if found:
        raise InvalidParameter(
            f"The training in the folder of the run was made of other masks or settings ({found}); the same ones, or "
            "another folder, are accepted.",
            part="run",
        )
    with intact(path.name):
        net.load_state_dict(state["net"])
        optimiser.load_state_dict(state["optimiser"])
        return int(state["step"])


def _save(
    net: CompletionNet, optimiser: torch.optim.Optimizer, made_of: Mapping[str, Any], step: int, path: Path
) -> None:
    state = {**made_of, "net": net.state_dict(), "optimiser": optimiser.state_dict(), "step": step}
    torch.save(state, path.with_suffix(".new"))
    path.with_suffix(".new").replace(path)
