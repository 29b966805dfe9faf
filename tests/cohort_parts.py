"""Masks and folders of masks that tests of cohorts share."""

import csv

import nibabel as nib
import numpy as np

from model.geometry import Grid
from training.cohorts import Case, CohortOptions, Provenance
from training.cohorts.sources import CohortSource, open_cohort

OPTIONS = CohortOptions(validation_fraction=0.0)
OWN = Provenance("made here", "CC0", "nobody", shippable=True)


def ball(radius=6.0, size=20, centre=None, stretch=(1.0, 1.0, 1.0)):
    centre = np.full(3, (size - 1) / 2) if centre is None else np.asarray(centre)
    index = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1)
    return (((index - centre) / stretch) ** 2).sum(axis=-1) <= radius**2


def egg(n):
    """A mask of one of many ellipsoids."""
    index = np.stack(np.meshgrid(*[np.arange(28)] * 3, indexing="ij"), axis=-1)
    return (((index - 13.5) / [8.0 + 0.4 * n, 9.0, 10.0 - 0.3 * n]) ** 2).sum(axis=-1) <= 1.0


def case(name, mask, *, split="train", person=None, spacing=1.0):
    affine = np.diag([spacing, spacing, spacing, 1.0])
    return Case(name, person or name, split, mask, Grid(mask.shape, affine))


def balls(count=8, **more):
    return [case(f"c{n}", ball(5.0 + 0.2 * n, centre=(9.5 + 0.05 * n, 9.5, 9.5)), **more) for n in range(count)]


def write(folder, name, mask, affine=None):
    folder.mkdir(parents=True, exist_ok=True)
    image = nib.Nifti1Image(mask.astype(np.uint8), np.eye(4) if affine is None else affine)
    nib.save(image, folder / f"{name}.nii.gz")


def write_table(folder, rows):
    with (folder / "cases.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


def lopsided():
    """A ball with a bump, which no turn or reflection maps onto itself."""
    return ball() | ball(3.0, 20, (15.0, 13.0, 11.0))


def restored(mask, affine, axes, flips):
    """The same voxels at the same places, axes stored in another order and some of them backwards."""
    change = np.zeros((4, 4))
    change[3, 3] = 1.0
    for new, (old, flip) in enumerate(zip(axes, flips, strict=True)):
        change[old, new] = -1.0 if flip else 1.0
        change[old, 3] = mask.shape[old] - 1 if flip else 0.0
    stored = mask.transpose(axes)[tuple(slice(None, None, -1 if flip else 1) for flip in flips)]
    return np.ascontiguousarray(stored), affine @ change


def write_balls(folder, count=6):
    for n in range(count):
        write(folder, f"ball{n}", ball(5.0 + 0.3 * n))


def save(path, values, affine=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    nib.save(nib.Nifti1Image(np.asarray(values).astype(np.uint8), np.eye(4) if affine is None else affine), path)


def opened(options=OPTIONS, **source):
    return open_cohort(CohortSource(**source), options)
