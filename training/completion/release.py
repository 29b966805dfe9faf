"""A bundle with a completion network, trained for it on a cohort."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from model.bundle import file_digest, read_manifest, write_manifest
from model.networks.completion import MULTIPLE
from model.networks.completion_export import export_completion
from training.calibration import UNCALIBRATED_SHARE
from training.cohorts.cohort import Cohort
from training.completion.samples import lattice_for, windows_of
from training.completion.trainer import CompletionConfig, Watch, train_completion
from training.points import Window
from training.runs import mask_digest
from training.seen import check_seen

#: Voxels of the lattice at most, and its least step (mm).
MOST_VOXELS, LEAST_STEP_MM = 110_000, 1.0


def completion_config(
    cohort: Cohort, windows: Sequence[Window], *, reflect: bool | None, steps: int | None, seed: int
) -> CompletionConfig:
    """The configuration for a cohort.

    Args:
        reflect: whether every other sample is a mirror image; where the cohort says that it has both sides, or that
            there are none, when None: not where no side is stated.
    """
    reflected = cohort.side in ("mixed", "unpaired") if reflect is None else reflect
    lattice = lattice_for(windows, MOST_VOXELS, LEAST_STEP_MM, MULTIPLE)
    config = CompletionConfig(lattice.voxels, lattice.step_mm, reflected=reflected, seed=seed)
    return config if steps is None else replace(config, steps=steps)


def complete_bundle(
    folder: Path,
    cohort: Cohort,
    run: Path,
    *,
    reflect: bool | None = None,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    watch: Watch = lambda step, loss: None,
) -> CompletionConfig:
    """Train a network on the cohort's training masks and put it into the bundle, which is to be calibrated anew.

    Args:
        run: folder of the training's checkpoint, from which it goes on.
        reflect, steps: as in `completion_config`; `CompletionConfig`'s when None.

    Raises:
        BundleError: the bundle cannot be trusted.
        InvalidParameter: the folder holds a training of other masks or settings, or the model was not trained on one
            of the masks.
        ParityError: the exported graphs disagree with the network.
    """
    manifest, _ = read_manifest(folder)
    check_seen(manifest, cohort.train)
    windows = windows_of(cohort.train)
    config = completion_config(cohort, windows, reflect=reflect, steps=steps, seed=seed)
    masks = [mask_digest(case) for case in cohort.train]
    net = train_completion(windows, config, run, masks=masks, device=device, watch=watch)
    written = export_completion(net, folder)
    facts = {
        "voxels": list(config.voxels),
        "step_mm": config.step_mm,
        "share": UNCALIBRATED_SHARE,
        "training": {**asdict(config), "cohort": cohort.name, "shapes": len(cohort.train)},
    }
    files = {**manifest.files, **{name: file_digest(folder / name) for name in written}}
    # What was measured before does not hold any more.
    write_manifest(replace(manifest, completion=facts, accuracy={}, files=dict(sorted(files.items()))), folder)
    return config
