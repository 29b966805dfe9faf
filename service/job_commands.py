"""The commands ``jobs ...``: long work from the command line, by the same engine and with the same progress."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from subprocess import Popen
from tempfile import TemporaryFile
from typing import Annotated, Any, BinaryIO

import typer

from model.errors import InvalidParameter
from model.inference.calipers import USUAL_TEXT, parse_extents
from model.inference.fitting import MirrorRule
from model.inference.reconstruction import UncertaintyRule
from model.inference.stacks import checked_labels
from model.inference.surface import require_step
from service import use_cases
from service.commands import ExtentsOption, FidelityOption, ForceOption, JsonOption, ModelOption, RejectOption
from service.console import bar, echo_json, require_free, writing
from service.errors import NotReady
from service.job_archives import zip_of_folder
from service.job_files import JobFiles
from service.job_ports import BlobStore, JobEngine, JobState, JobStatus
from service.job_presentation import job_summary
from service.job_results import write_zip
from service.job_submission import JobDesk, require_archive
from service.jobs.worker import start_worker, supervised_workers
from service.model_registry import pinned_name
from service.observability import make_log
from service.ports import RECONSTRUCTIONS_JOB, SAMPLES_JOB, MeshFormat, SampleFormat
from service.request_schemas import parse_annotated, parse_labels
from service.settings import Settings, load_settings
from service.stores import open_blobs, open_jobs, require_jobs, require_places

#: How often (s) a job is looked at.
_POLL_S = 0.5
#: Slots of one command's own workers, at most; with its number among processes before them, they are nobody else's.
_OWN_SLOTS = 1000

OutputOption = Annotated[Path | None, typer.Option(help="ZIP to write; waits for the job. Left out: only begins it.")]
ResultOption = Annotated[Path | None, typer.Option(help="ZIP to write once the job is done.")]
KeyOption = Annotated[str | None, typer.Option(help="The same key with the same kind leads to the same job.")]
IdArgument = Annotated[str, typer.Argument(metavar="ID", help="Identifier of the job.")]


def jobs_commands() -> typer.Typer:
    """The group of commands."""
    app = typer.Typer(help="Long work that survives a restart.")
    app.command("sample")(sample_job)
    app.command("reconstruct")(reconstruct_job)
    app.command("watch")(watch_job)
    app.command("cancel")(cancel_job)
    return app


def sample_job(
    context: typer.Context,
    output: OutputOption = None,
    model: ModelOption = None,
    count: Annotated[int, typer.Option(help="How many.")] = 16,
    seed: Annotated[int, typer.Option(help="Seed of the first one; the next one's is one more.")] = 0,
    format: Annotated[SampleFormat, typer.Option(help="File format.")] = SampleFormat.STL,
    temperature: Annotated[float, typer.Option(help="Spread of the shapes; 1 is the population's.")] = 1.0,
    spacing_mm: Annotated[float | None, typer.Option(help="Grid step (mm); the model's when left out.")] = None,
    reject: RejectOption = True,
    key: KeyOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Draw thousands of synthetic shapes."""
    require_free({"--output": output}, force=force)
    settings = load_settings()
    chosen = context.obj(settings).get(model)
    use_cases.batch_seeds(seed, count, settings.max_job_samples)
    require_step(chosen, spacing_mm, settings.max_voxels)
    asked = {
        "model": model,
        "count": count,
        "seed": seed,
        "format": format.value,
        "temperature": temperature,
        "spacing_mm": spacing_mm,
        "reject": reject,
    }
    _begin(settings, (SAMPLES_JOB, asked, ()), pinned_name(chosen), key, output, as_json=as_json)


def reconstruct_job(
    context: typer.Context,
    masks: Annotated[Path, typer.Argument(metavar="MASKS", help="Folder or ZIP of masks, each of one object.")],
    output: OutputOption = None,
    model: ModelOption = None,
    format: Annotated[MeshFormat, typer.Option(help="File format.")] = MeshFormat.STL,
    label: Annotated[list[str] | None, typer.Option(help="Label value or values; all non-zero when left out.")] = None,
    annotated: Annotated[str, typer.Option(help="auto, all, nonempty, or a JSON list of planes.")] = "auto",
    uncertainty: Annotated[UncertaintyRule, typer.Option(help="How uncertainty is found.")] = "laplace",
    mirror: Annotated[MirrorRule, typer.Option(help="Whether left and right are exchanged.")] = "never",
    resolution_mm: Annotated[float | None, typer.Option(help="Grid step of the surface (mm).")] = None,
    seed: Annotated[int, typer.Option(min=0, max=use_cases.MAX_SEED, help="Makes the answer repeatable.")] = 0,
    fidelity: FidelityOption = None,
    extents: ExtentsOption = USUAL_TEXT,
    key: KeyOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Reconstruct each mask of a folder or a ZIP."""
    require_free({"--output": output}, force=force)
    checked_labels(parse_labels(label or []))
    parse_extents(extents)
    settings = load_settings()
    chosen = context.obj(settings).get(model)
    require_step(chosen, resolution_mm, settings.max_voxels, part="resolution_mm")
    asked = {
        "model": model,
        "format": format.value,
        "label": label or [],
        "annotated": annotated,
        "uncertainty": uncertainty,
        "mirror": mirror,
        "resolution_mm": resolution_mm,
        "seed": seed,
        "fidelity": fidelity,
        "extents": extents,
    }
    with _archive(masks) as archive:
        require_archive(archive, parse_annotated(annotated), settings.archive_limits)
        job = RECONSTRUCTIONS_JOB, asked, (archive,)
        _begin(settings, job, pinned_name(chosen), key, output, as_json=as_json)


def watch_job(identifier: IdArgument, output: ResultOption = None, force: ForceOption = False) -> None:
    """Follow a job to its end; --output writes what it made."""
    require_free({"--output": output}, force=force)
    settings = load_settings()
    require_jobs(settings)
    with closing(open_jobs(settings)) as jobs:
        status = jobs.status(identifier)
        if output is not None:
            _require_zip(status.kind)
        _finish(jobs, open_blobs(settings), status, output, as_json=False)


def cancel_job(identifier: IdArgument, as_json: JsonOption = False) -> None:
    """Stop a job."""
    settings = load_settings()
    require_jobs(settings)
    with closing(open_jobs(settings)) as jobs:
        _tell(jobs.cancel(identifier), as_json=as_json)


#: A job's kind, its argument as it was asked for, and its inputs.
Job = tuple[str, dict[str, Any], tuple[BinaryIO, ...]]


def _begin(settings: Settings, job: Job, model: str, key: str | None, output: Path | None, *, as_json: bool) -> None:
    require_places(settings)
    blobs = open_blobs(settings)
    with closing(open_jobs(settings)) as jobs:
        status = JobDesk(jobs, blobs, settings.max_jobs).submit(*job, key, model=model)
        if output is None:
            _tell(status, as_json=as_json)
            return
        with _own_workers(max(1, settings.job_workers)) as begin:
            look = partial(_require_workers, lambda: jobs.workers(settings.job_lease_s), begin)
            _finish(jobs, blobs, status, output, as_json=as_json, look=look)


@contextmanager
def _own_workers(count: int) -> Iterator[Callable[[], None]]:
    """What starts so many workers of this command's own, which end with the context; once they run it does nothing."""
    with ExitStack() as own:
        begun: list[object] = []

        def begin() -> None:
            if not begun:
                begun.append(own.enter_context(supervised_workers(count, make_log("error"), _start_own)))

        yield begin


def _start_own(number: int) -> "Popen[bytes]":
    """A worker under a name of this command's own: one that is about to leave may still hold that of its slot."""
    return start_worker(os.getpid() * _OWN_SLOTS + number)


def _require_workers(alive: Callable[[], int], begin: Callable[[], None]) -> None:
    """Begin own workers when nobody works, or nobody works any more."""
    if not alive():
        begin()


def _require_zip(kind: str) -> None:
    """Refuse to wait for a ZIP that a job will not make."""
    if kind not in (SAMPLES_JOB, RECONSTRUCTIONS_JOB):
        raise InvalidParameter(
            f"--output accepts a job of kind {SAMPLES_JOB} or {RECONSTRUCTIONS_JOB}, which makes a ZIP; "
            f"leave it out for this one of kind {kind}.",
            part="--output",
        )


def _finish(
    jobs: JobEngine,
    blobs: BlobStore,
    status: JobStatus,
    output: Path | None,
    *,
    as_json: bool,
    look: Callable[[], None] = lambda: None,
) -> None:
    """Wait for a job's end, with a look at its workers each time, and write what it has made."""
    with bar() as advance:
        while not status.state.is_final:
            look()
            time.sleep(_POLL_S)
            status = jobs.status(status.id)
            advance(status.kind, status.done, status.total)
    if status.state is JobState.DONE and output is not None and status.result is not None:
        with writing("--output"):
            write_zip(output, JobFiles(blobs, status.id), status.kind, status.result["count"])
    _tell(status, as_json=as_json)
    if status.state is not JobState.DONE:
        raise NotReady(status.problem or f"The job has no result: it is {status.state.value}.")


def _tell(status: JobStatus, *, as_json: bool) -> None:
    if as_json:
        echo_json(job_summary(status))
    else:
        typer.echo(f"{status.id} {status.state.value}: {status.done} of {status.total or '?'}")


@contextmanager
def _archive(masks: Path) -> Iterator[BinaryIO]:
    if not masks.exists():
        raise InvalidParameter("MASKS must be a folder or a ZIP that exists.", part="MASKS")
    with TemporaryFile() if masks.is_dir() else masks.open("rb") as archive:
        if masks.is_dir():
            zip_of_folder(masks, archive)
        yield archive
