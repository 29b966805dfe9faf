"""What the tests of sweeps share: tiny masks, settings of a moment, and a result that nobody measured."""

from dataclasses import replace

import nibabel as nib
import numpy as np
import typer
from typer.testing import CliRunner

from training.cli import register
from training.sweep.cell import Effort
from training.sweep.table import Result

EFFORT = Effort(steps=8, calibrate=False, samples=4)
QUICK = [
    "--latent-size",
    "3",
    "--steps",
    "8",
    "--samples",
    "4",
    "--no-calibrate",
    "--device",
    "cpu",
    "--regime",
    "thin",
]


def result(key="a", **more):
    measured = {"thin": {"one": {"dice": 0.9, "asd_mm": 0.5, "hd95_mm": 2.0, "hd_mm": 4.0}, "two": None}}
    values = Result(
        key, "thin", 4, "flow-ard", 0, "variational", "vertebra", "made here", "CC0", True, 5, 8, 1.5, [1.0, 0.5],
        [1, 2, 2], [1.0, 2.0, 3.0], [0.1, 0.2, 0.3], measured,
    )  # fmt: skip
    return replace(values, **more)


def ellipsoid(n):
    index = np.stack(np.meshgrid(*[np.arange(28)] * 3, indexing="ij"), axis=-1)
    return (((index - 13.5) / [8.0 + 0.4 * n, 9.0, 10.0 - 0.3 * n]) ** 2).sum(axis=-1) <= 1.0


def write_masks(folder):
    """Six ellipsoids to train on and two to measure on."""
    for n in range(8):
        split = folder / ("test" if n > 5 else "train")
        split.mkdir(exist_ok=True)
        nib.save(nib.Nifti1Image(ellipsoid(n).astype(np.uint8), np.eye(4)), split / f"e{n}.nii.gz")
    return folder


def call(*words):
    app = typer.Typer()
    register(app)
    return CliRunner().invoke(app, [str(word) for word in words])
