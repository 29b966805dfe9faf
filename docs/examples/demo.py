"""One go through the service: request, mesh, uncertainty map and a picture of both.

Starts the service on a free port, sends three annotated slices, and writes mesh.ply, uncertainty.nii.gz,
summary.json and picture.png.

    python docs/examples/demo.py build/demo
"""

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import typer
from picture import draw

EXAMPLE = Path(__file__).with_name("hippocampus_three_slices.nii.gz")
START_LIMIT_S = 120.0


def free_port() -> int:
    """A port that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def running_service() -> Iterator[httpx.Client]:
    """The service with the models that ship, on this machine alone; gone afterwards, with its results."""
    port = free_port()
    with tempfile.TemporaryDirectory() as results:
        environment = {**os.environ, "MORPHOFLOW_RESULTS_FOLDER": results, "MORPHOFLOW_LOG_LEVEL": "warning"}
        program = Path(sys.executable).with_name("morphoflow")
        command = [str(program), "serve", "--host", "127.0.0.1", "--port", str(port)]
        service = subprocess.Popen(command, env=environment)
        try:
            with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=120.0) as client:
                wait_until_ready(client, service)
                yield client
        finally:
            service.send_signal(signal.SIGTERM)
            service.wait(timeout=30)


def wait_until_ready(client: httpx.Client, service: subprocess.Popen[bytes]) -> None:
    """Return once /readyz says so; stop the program when the service ends or takes too long."""
    limit = time.monotonic() + START_LIMIT_S
    while time.monotonic() < limit and service.poll() is None:
        try:
            if client.get("/readyz").is_success:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.2)
    raise SystemExit("The service did not become ready.")


def reconstruct(client: httpx.Client, mask: Path) -> dict[str, Any]:
    """Summary of the reconstruction from one mask."""
    with mask.open("rb") as content:
        files = {"mask": (mask.name, content)}
        answer = client.post("/v1/reconstructions", files=files, data={"model": "hippocampus"})
    if answer.is_error:
        raise SystemExit(f"The service refused the mask: {answer.json().get('detail', answer.status_code)}")
    summary: dict[str, Any] = answer.json()
    return summary


def fetch(client: httpx.Client, link: str, target: Path) -> Path:
    """Save one part of a result."""
    target.write_bytes(client.get(link).raise_for_status().content)
    return target


def sentence(summary: dict[str, Any]) -> str:
    """What was found, in words."""
    volume = summary["volume_ml"]
    return (
        f"{summary['model']['name']}: {volume['value']:.2f} mL "
        f"(90 % interval {volume['low']:.2f} to {volume['high']:.2f}), surface known to "
        f"{summary['surface_sd']['mean_mm']:.2f} mm on average; {summary['fit']['message']}"
    )


def main(folder: Path, mask: Path = EXAMPLE) -> None:
    """Reconstruct MASK and write all that the service answers to FOLDER."""
    folder.mkdir(parents=True, exist_ok=True)
    with running_service() as client:
        started = time.perf_counter()
        summary = reconstruct(client, mask)
        typer.echo(f"{sentence(summary)} ({time.perf_counter() - started:.2f} s)")
        links = summary["links"]
        mesh = fetch(client, links["mesh"], folder / "mesh.ply")
        entropy = fetch(client, links["uncertainty"], folder / "uncertainty.nii.gz")
        surface_sd = client.get(links["surface_sd"]).raise_for_status().json()["surface_sd_mm"]
    (folder / "summary.json").write_text(json.dumps(summary, indent=2))
    draw(mask, mesh, surface_sd, entropy, folder / "picture.png")
    typer.echo(f"mesh.ply, uncertainty.nii.gz, summary.json and picture.png are in {folder}")


if __name__ == "__main__":
    typer.run(main)
