"""The command line: ``morphoflow serve | reconstruct | sample | models | modes``, and commands of other packages.

Exit status: 0 done, 2 the input is at fault (one sentence on standard error), 1 a fault of the program.
"""

import signal
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml
from threadpoolctl import threadpool_limits

from model.errors import CohortError, InputError, MorphoFlowError, NotFound
from service.adapters.processes import spread
from service.app import create_app, interface_document
from service.commands import OpenRegistry, models, reconstruct, sample
from service.console import writing
from service.dicom_commands import audit, deidentify, resend
from service.extras import install_line, require_extras
from service.job_commands import jobs_commands
from service.jobs.worker import run_worker, supervised_workers
from service.mode_commands import modes
from service.model_registry import ModelRegistry, load_registry
from service.observability import Log, log_everything
from service.serving import Server
from service.settings import Settings, load_settings, require_protection
from service.stores import require_places
from service.wiring import program_version

PROGRAM = "morphoflow"
#: Packages that bring further commands register a callable that takes the typer application.
COMMAND_GROUP = "morphoflow.commands"
BAD_INPUT, FAULT = 2, 1

VersionOption = Annotated[bool, typer.Option("--version", help="Print the version.")]


def main(arguments: Sequence[str] | None = None, open_registry: OpenRegistry = load_registry) -> int:
    """Run one command.

    Args:
        arguments: the words after the program's name; those of the process when None.
        open_registry: finds the models that the settings ask for.

    Returns:
        The exit status.
    """
    # The factorisations of a fit are small: BLAS spends longer waiting for its own threads than computing.
    threadpool_limits(limits=1, user_api="blas")
    words = list(sys.argv[1:] if arguments is None else arguments)
    app = build_app()
    missing = load_plugins(app, entry_points(group=COMMAND_GROUP))
    if missing and words and not words[0].startswith("-") and words[0] not in command_names(app):
        typer.echo("\n".join(missing), err=True)
        return BAD_INPUT
    try:
        app(args=words, prog_name=PROGRAM, obj=open_registry)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else FAULT if stop.code else 0
    except (InputError, NotFound, CohortError) as error:
        typer.echo(f"{PROGRAM}: {error}", err=True)
        return BAD_INPUT
    except MorphoFlowError as error:
        typer.echo(f"{PROGRAM}: {error}", err=True)
        return FAULT
    return 0


def build_app() -> typer.Typer:
    """The commands of the service."""
    app = typer.Typer(
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    app.callback(invoke_without_command=True)(_program)
    for command in (serve, worker, reconstruct, sample, models, modes, deidentify, audit, resend, openapi):
        app.command()(command)
    app.add_typer(jobs_commands(), name="jobs")
    return app


def load_plugins(app: typer.Typer, entries: Iterable[EntryPoint]) -> list[str]:
    """Let other packages add their commands; a sentence for each that lacks a library."""
    sentences = []
    for entry in entries:
        try:
            entry.load()(app)
        except ImportError as error:
            library = (error.name or "a library").split(".")[0]
            line = install_line(entry.name)
            sentences.append(f"The commands of {entry.name} need {library}; install them with: {line}")
    return sentences


def command_names(app: typer.Typer) -> set[str]:
    """Names of the commands that an application has."""
    commands = {info.name or getattr(info.callback, "__name__", "") for info in app.registered_commands}
    return {name.replace("_", "-") for name in commands | {group.name or "" for group in app.registered_groups}}


def serve(
    context: typer.Context,
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="Port to listen on.")] = None,
) -> None:
    """Answer HTTP requests."""
    given: dict[str, Any] = {"host": host, "port": port}
    settings = load_settings({name: value for name, value in given.items() if value is not None})
    require_protection(settings)
    require_extras(settings)
    require_places(settings)
    log = log_everything(settings.log_level)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # the server calls it once it has left
    registry = context.obj(settings)
    helping = settings.model_copy(update={"threads": settings.threads or 1})
    _tell_example(log, example_request(settings, registry.names()))
    with (
        spread(settings.workers - 1, partial(_models_of_helper, helping), log) as compute,
        supervised_workers(settings.job_workers, log) as end_workers,
    ):
        _run(Server(create_app(settings, registry=registry, compute=compute, log=log), end_workers))


def _run(server: Server) -> None:
    with suppress(KeyboardInterrupt):  # that is how a server ends that is told to from the keyboard
        server.run()
    if not server.started:
        raise typer.Exit(FAULT)


def _models_of_helper(settings: Settings) -> ModelRegistry:
    log_everything(settings.log_level)
    return load_registry(settings)


def _tell_example(log: Log, example: str) -> None:
    """A request to begin with: for a person at a terminal, else as an entry of the log like all others."""
    if sys.stderr.isatty():
        typer.echo(f"A request from another terminal, with a mask file of yours:\n\n  {example}\n", err=True)
    else:
        log.info("example", request=example)


def worker(
    context: typer.Context,
    slot: Annotated[int, typer.Option(min=0, help="Number of this worker on this machine; each has its own.")] = 0,
    attached: Annotated[bool, typer.Option("--attached", help="End when standard input ends.")] = False,
) -> None:
    """Do jobs until told to stop."""
    settings = load_settings()
    require_extras(settings)
    require_places(settings)
    log = log_everything(settings.log_level)
    settings = settings.model_copy(update={"threads": settings.threads or 1})
    run_worker(settings, context.obj(settings), slot, log, attached=attached)


def openapi(
    output: Annotated[Path | None, typer.Option(help="File to write; standard output when left out.")] = None,
) -> None:
    """Write the interface's description (openapi.yaml)."""
    text = interface_yaml()
    if output is None:
        typer.echo(text, nl=False)
    else:
        with writing("--output"):
            output.write_text(text, encoding="utf-8")


def interface_yaml() -> str:
    """The interface's description as it stands in ``openapi.yaml``."""
    return yaml.safe_dump(interface_document(), sort_keys=False, allow_unicode=True, width=120)


def example_request(settings: Settings, models: Sequence[str]) -> str:
    """A request for the shell that works as it stands; the model is named where several are loaded."""
    host = "127.0.0.1" if settings.host in ("0.0.0.0", "::") else settings.host
    address = f"[{host}]" if ":" in host else host
    key = '-H "X-API-Key: $KEY" ' if settings.keys else ""
    url = f"http://{address}:{settings.port}{settings.root_path}/v1/reconstructions"
    model = f"-F model={models[0]} " if len(models) > 1 else ""
    return f"curl {key}-H 'Accept: model/stl' {model}-F mask=@mask.nii.gz -o surface.stl {url}"


def _program(context: typer.Context, version: VersionOption = False) -> None:
    """Complete 3-D anatomy, with its uncertainty, from a few annotated slices."""
    if version or context.invoked_subcommand is None:
        typer.echo(program_version() if version else context.get_help())
        raise typer.Exit


if __name__ == "__main__":
    sys.exit(main())
