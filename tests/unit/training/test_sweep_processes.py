"""Sweeps that are killed, share their work, or train side by side."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import torch

from tests.sweep_parts import QUICK, ellipsoid, write_masks
from training.choices import DeviceName
from training.cohorts import CohortOptions
from training.cohorts.sources import CohortSource
from training.sweep.cell import Effort
from training.sweep.plan import by_training, cells_of
from training.sweep.priors import PriorName
from training.sweep.streams import Progress, train_side_by_side
from training.sweep.table import done, read_results
from training.sweep.workers import Sweep, held, refusals, start_workers, work, work_together


@pytest.fixture(scope="module")
def masks(tmp_path_factory):
    return write_masks(tmp_path_factory.mktemp("masks"))


def test_workers_are_told_of_one_thread_and_their_caller_keeps_its_own(masks, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    before = dict(os.environ)
    sweep = Sweep(CohortSource(masks=masks), CohortOptions(), (), tmp_path, Effort(), DeviceName.CPU)
    (worker,) = start_workers(sweep, 1)
    end = time.monotonic() + 30.0
    while not (told := Path(f"/proc/{worker.pid}/environ").read_bytes()):  # empty until its program is started
        assert time.monotonic() < end
        time.sleep(0.01)
    told = set(told.split(b"\0"))
    assert {b"OMP_NUM_THREADS=1", b"MKL_NUM_THREADS=1"} <= told
    assert dict(os.environ) == before
    worker.join()
    assert worker.exitcode == 0


def test_a_killed_sweep_goes_on_from_its_checkpoint(masks, tmp_path, repository):
    folder = tmp_path / "out"
    words = ["sweep", "--masks", str(masks), *QUICK, "--steps", "1200", "--prior", "plain", "--output", str(folder)]
    program = "import typer; from training.cli import register; app = typer.Typer(); register(app); app()"
    environment = {**os.environ, "PYTHONPATH": str(repository)}

    def start():
        return subprocess.Popen(
            [sys.executable, "-c", program, *words, "--jobs", "1"],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip

    first = start()
    while not list(folder.glob("trainings/*/run/checkpoint.pt")) and first.poll() is None:
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGKILL)
    first.communicate()
    checkpoint = next(folder.glob("trainings/*/run/checkpoint.pt"))
    reached = torch.load(checkpoint, weights_only=True)["step"]
    assert 0 < reached <= 1200
    events = len(list(folder.glob("trainings/*/run/figures/*")))
    output, _ = (second := start()).communicate()
    assert second.returncode == 0, output
    (one,) = read_results(folder)
    assert one.steps == 1200
    assert len(list(folder.glob("trainings/*/run/figures/*"))) >= events


def test_a_process_of_torchrun_waits_for_the_others(masks, tmp_path, repository):
    """torchrun ends all of its processes with the first that fails, and one with nothing left to do must not."""
    folder = tmp_path / "out"
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    words = ["sweep", "--masks", str(masks), *QUICK, "--latent-size", "4", "--prior", "plain", "--output", str(folder)]
    answer = subprocess.run(
        [*torchrun, "-m", "service.cli", *words], env={**os.environ, "PYTHONPATH": str(repository)},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr[-2000:]
    assert len(read_results(folder)) == 2


def test_what_another_process_leaves_unfinished_is_taken_over(masks, tmp_path):
    cells = tuple(cells_of([3], ["thin"], [PriorName.PLAIN], [0], "variational"))
    effort = Effort(steps=8, calibrate=False, samples=0)
    plan = Sweep(CohortSource(masks=masks), CohortOptions(), cells, tmp_path, effort, DeviceName.CPU)
    other = multiprocessing.get_context("spawn").Process(
        target=hold_for, args=(tmp_path / "trainings" / cells[0].training_key, 4.0)
    )
    other.start()
    while not list(tmp_path.glob("trainings/*/lock")):
        time.sleep(0.02)
    work(plan)
    assert not (tmp_path / "results.jsonl").exists()
    work_together(plan)
    assert len(read_results(tmp_path)) == 1
    other.join()


def hold_for(folder, seconds):
    with held(folder):
        time.sleep(seconds)


class TestSideBySide:
    """On a CPU here; on a GPU each training has a stream of its own besides."""

    def plan(self, masks, folder, steps=8):
        cells = tuple(cells_of([3, 4], ["thin", "thick"], [PriorName.PLAIN, PriorName.FLOW_ARD], [0], "variational"))
        effort = Effort(steps=steps, calibrate=False, samples=0)
        return Sweep(CohortSource(masks=masks), CohortOptions(), cells, folder, effort, DeviceName.CPU)

    def weights(self, folder):
        found = {}
        for path in folder.glob("trainings/*/run/checkpoint.pt"):
            state = torch.load(path, weights_only=True)
            found[path.parts[-3]] = (state["step"], state["module"])
        return found

    def test_each_training_is_the_one_that_it_would_be_alone(self, masks, tmp_path):
        seen = []
        plan = self.plan(masks, tmp_path / "together")
        train_side_by_side(plan, seen.append)
        found = self.weights(plan.folder)
        assert len(found) == 4
        assert seen[-1] == Progress(begun=4, ended=4, steps=4 * 8, all_steps=4 * 8)
        for cell in {cell.training_key: cell for cell in plan.cells}.values():
            alone = replace(plan, cells=(cell,), folder=tmp_path / "alone")
            train_side_by_side(alone)
        for key, (step, module) in self.weights(tmp_path / "alone").items():
            assert step == found[key][0] == 8
            for name, value in module.items():
                torch.testing.assert_close(found[key][1][name], value)

    def test_what_is_there_and_what_another_holds_is_left(self, masks, tmp_path):
        plan = self.plan(masks, tmp_path)
        first = by_training(plan.cells)
        with held(tmp_path / "trainings" / next(iter(first))):
            train_side_by_side(plan)
        assert set(self.weights(tmp_path)) == set(list(first)[1:])
        times = {path: path.stat().st_mtime_ns for path in tmp_path.glob("trainings/*/run/checkpoint.pt")}
        train_side_by_side(plan)
        assert len(self.weights(tmp_path)) == 4
        assert all(path.stat().st_mtime_ns == time for path, time in times.items())

    def test_a_training_of_other_masks_is_not_taken_for_finished(self, masks, tmp_path):
        shutil.copytree(masks, tmp_path / "masks")
        plan = self.plan(tmp_path / "masks", tmp_path / "sweep")
        train_side_by_side(plan)
        nib.save(nib.Nifti1Image(ellipsoid(9).astype(np.uint8), np.eye(4)), tmp_path / "masks" / "train" / "e0.nii.gz")
        work(plan)
        assert len(refusals(plan)) == len(plan.cells)
        assert done(plan.folder) == set()

    def test_the_workers_record_why_one_is_refused(self, masks, tmp_path):
        train_side_by_side(self.plan(masks, tmp_path))
        other = self.plan(masks, tmp_path, steps=9)
        train_side_by_side(other)
        work(other)
        assert len(refusals(other)) == len(other.cells)
        assert all("other masks or settings" in words for words in refusals(other).values())
