"""From POST to mesh: how long a request takes, and what memory the service needs.

Starts the service with its shipped models in a process of its own, sends sparse masks one after the other and reads
the surface (binary STL) from the answer. Masks are drawn from a cohort's test cases, three orthogonal slices and every
8th axial slice, or read from a file. The first request of each kind is not counted.

    python -m benchmarks.request --cohort hippocampus --data FOLDER
    python -m benchmarks.request --mask docs/examples/hippocampus_three_slices.nii.gz
"""

import gzip
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import httpx
import nibabel as nib
import numpy as np
import typer

from benchmarks.server import Server, serving
from training.cohort_options import DataOption
from training.cohorts import CohortName, CohortOptions, data_folder, load_cohort
from training.console import exit_status
from training.sparsify import Regime, for_evaluation

EXAMPLE = Path("docs/examples/hippocampus_three_slices.nii.gz")
REGIMES: tuple[Regime, ...] = ("orthogonal", "thin")
UNCERTAINTIES = ("none", "laplace")
MATRIX_SIZE = 1024


@dataclass(frozen=True)
class Posting:
    """A mask to send: what it is and the bytes of its file (NIfTI, gzip)."""

    regime: str
    content: bytes


@dataclass(frozen=True)
class Timing:
    """Requests of one kind: their count, and seconds from sending the mask to holding the mesh."""

    regime: str
    uncertainty: str
    requests: int
    failed: int
    median_s: float
    p99_s: float
    slowest_s: float


def main(
    model: Annotated[str | None, typer.Option(help="Name of a loaded model; the cohort's when left out.")] = None,
    bundle: Annotated[list[Path] | None, typer.Option(help="Folder of a further bundle; may repeat.")] = None,
    cohort: Annotated[CohortName | None, typer.Option(help="Cohort whose test cases are drawn.")] = None,
    data: DataOption = None,
    mask: Annotated[Path, typer.Option(help="Sparse mask (.nii.gz) that is sent when no cohort is named.")] = EXAMPLE,
    cases: Annotated[int, typer.Option(min=1, max=200, help="Cases of the cohort, at most.")] = 10,
    repeats: Annotated[int, typer.Option(min=1, max=200, help="Requests for each case and kind.")] = 5,
    limit_s: Annotated[float, typer.Option(min=1.0, max=3600.0, help="Stop sending after so many seconds.")] = 300.0,
    as_json: Annotated[bool, typer.Option("--json", help="Write JSON.")] = False,
) -> None:
    """Measure requests against the running service."""
    with exit_status():
        postings = list(drawn_cases(cohort, data, cases)) if cohort else [Posting("file", mask.read_bytes())]
    reference = matrix_rate()
    with serving(tuple(bundle or ())) as server:
        idle = server.peak_memory_mib()
        timings = measure(server, postings, model or (cohort or CohortName.HIPPOCAMPUS).value, repeats, limit_s)
        peak = server.peak_memory_mib()
    values = {
        "matrix_product_gflops": round(reference, 1),
        "memory_ready_mib": round(idle),
        "memory_peak_mib": round(peak),
        "requests": [asdict(timing) for timing in timings],
    }
    typer.echo(json.dumps(values, indent=2) if as_json else as_text(values, timings))


def drawn_cases(cohort: CohortName, data: Path | None, count: int) -> Iterator[Posting]:
    """Sparse drawings of a cohort's test cases, as the service's users send them: empty wherever nothing is drawn."""
    found = load_cohort(cohort, data_folder(data), CohortOptions(skip_refused=True))
    for regime in REGIMES:
        for case in found.test[:count]:
            drawing = for_evaluation(case.mask, case.grid, regime)
            image = nib.Nifti1Image(drawing.stack.foreground.astype(np.uint8), drawing.stack.grid.affine)
            yield Posting(regime, gzip.compress(image.to_bytes(), compresslevel=1))


def measure(server: Server, postings: Sequence[Posting], model: str, repeats: int, limit_s: float) -> list[Timing]:
    """Every kind of request, in turn, until the time is over."""
    end = time.monotonic() + limit_s
    found = []
    for regime in dict.fromkeys(posting.regime for posting in postings):
        mine = [posting for posting in postings if posting.regime == regime]
        for uncertainty in UNCERTAINTIES:
            form = {"uncertainty": uncertainty, "model": model}
            post(server.client, mine[0], form)
            seconds: list[float | None] = []
            for posting in [posting for _ in range(repeats) for posting in mine]:
                if time.monotonic() > end:
                    break
                seconds.append(post(server.client, posting, form))
            found.append(timing_of(regime, uncertainty, seconds))
    return found


def post(client: httpx.Client, posting: Posting, form: dict[str, str]) -> float | None:
    """Seconds from sending a mask to holding its mesh; None when the service refused."""
    begin = time.perf_counter()
    files = {"mask": ("mask.nii.gz", posting.content, "application/gzip")}
    answer = client.post("/v1/reconstructions", data=form, files=files, headers={"Accept": "model/stl"})
    return time.perf_counter() - begin if answer.is_success and len(answer.content) > 84 else None


def timing_of(regime: str, uncertainty: str, seconds: Sequence[float | None]) -> Timing:
    """Median, 99th percentile (nearest rank above) and slowest of the answered requests."""
    answered = [value for value in seconds if value is not None]
    figures = [float("nan")] * 3
    if answered:
        figures = [float(np.median(answered)), float(np.quantile(answered, 0.99, method="higher")), max(answered)]
    return Timing(regime, uncertainty, len(seconds), len(seconds) - len(answered), *figures)


def matrix_rate(repeats: int = 10) -> float:
    """Rate of single-precision matrix products of this machine with the threads allowed to it (GFLOP/s)."""
    rng = np.random.default_rng(0)
    a, b = (rng.standard_normal((MATRIX_SIZE, MATRIX_SIZE), dtype=np.float32) for _ in range(2))
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        a @ b
        times.append(time.perf_counter() - begin)
    return float(2.0 * MATRIX_SIZE**3 / np.median(times) / 1e9)


def as_text(values: dict[str, object], timings: Sequence[Timing]) -> str:
    """A table."""
    lines = [
        f"{'masks':<12}{'uncertainty':<13}{'requests':>9}{'failed':>8}{'median s':>10}{'p99 s':>8}{'slowest s':>11}"
    ]
    lines += [
        f"{one.regime:<12}{one.uncertainty:<13}{one.requests:>9}{one.failed:>8}"
        f"{one.median_s:>10.3f}{one.p99_s:>8.3f}{one.slowest_s:>11.3f}"
        for one in timings
    ]
    lines.append(f"memory: {values['memory_ready_mib']} MiB when ready, {values['memory_peak_mib']} MiB at most")
    lines.append(f"matrix product of this machine: {values['matrix_product_gflops']} GFLOP/s (float32)")
    return "\n".join(lines)


if __name__ == "__main__":
    typer.run(main)
