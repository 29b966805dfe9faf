"""``python -m benchmarks.pacs``: the scene beside a real archive, and the storm."""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.pacs.scene import play
from benchmarks.pacs.storm import storm
from training.cohort_options import DataOption

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command("scene")
def _scene(
    folder: Annotated[Path, typer.Option(help="Emptied, then used.")] = Path("build/pacs"),
    data: DataOption = None,
    dicomweb: Annotated[bool, typer.Option("--dicomweb", help="Reach and be reached by DICOMweb.")] = False,
) -> None:
    """Three planes drawn on a series become results in the archive."""
    if not play(folder, data, dicomweb=dicomweb).is_right:
        raise typer.Exit(1)


@app.command("storm")
def _storm(
    folder: Annotated[Path, typer.Option(help="Emptied, then used.")] = Path("build/storm"),
    studies: Annotated[int, typer.Option(min=1)] = 500,
    kills: Annotated[int, typer.Option(min=0)] = 10,
    seed: Annotated[int, typer.Option(help="Decides when the service is killed.")] = 0,
    direct: Annotated[bool, typer.Option("--direct", help="Send to the service, not to the archive.")] = False,
) -> None:
    """Many studies at once, the service killed on the way."""
    count = storm(folder, studies, kills, seed, typer.echo, direct=direct)
    typer.echo(count.sentence(studies))


if __name__ == "__main__":
    app()
