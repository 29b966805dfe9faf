"""A service keeps itself up while it runs, whatever becomes of one turn, and leaves nothing open at its end."""

import asyncio
import json
import shutil
import time
from contextlib import contextmanager
from dataclasses import replace
from io import StringIO

import pytest

from model.bundle import POPULATION, file_digest, read_manifest, write_manifest
from service.app import create_app, lifespan
from service.model_registry import ModelRegistry, load_registry
from service.observability import make_log
from tests.analytic_model import ellipsoid_model
from tests.service_parts import app_for, running, settings_for
from tests.waiting import until


def until_listed(client, *names, limit_s=120.0):
    """Wait for the models of a service to be these."""
    end = time.monotonic() + limit_s
    while (found := [model["name"] for model in client.get("/v1/models").json()["models"]]) != list(names):
        assert time.monotonic() < end, found
        time.sleep(0.05)


def until_broken(client, *names, limit_s=120.0):
    """Wait until the service says that it has not loaded these."""
    end = time.monotonic() + limit_s
    while (found := [model["name"] for model in client.get("/readyz").json()["broken"]]) != list(names):
        assert time.monotonic() < end, found
        time.sleep(0.05)


def events(log):
    return [json.loads(line)["event"] for line in log.getvalue().splitlines()]


def served(folder, registry, log):
    settings = settings_for(folder, sweep_interval_s=0.05)
    return create_app(settings, registry=registry, log=make_log("info", log))


def test_a_turn_that_fails_is_told_and_later_ones_find_models(tmp_path):
    turns, log = iter(range(1000)), StringIO()

    def reload():
        if next(turns) < 3:
            raise LookupError("a folder that went while it was read")
        return ModelRegistry({"bone": ellipsoid_model("bone")})

    with running(served(tmp_path, ModelRegistry({}, reload=reload), log)) as client:
        until_listed(client, "bone")
    assert events(log).count("models cannot be found anew") == 3
    assert events(log)[-1] == "stopped"


def damaged(bundle, folder):
    """A copy that its manifest vouches for and no program can read."""
    shutil.copytree(bundle, folder)
    (folder / POPULATION).write_bytes(b"garbage")
    manifest, _ = read_manifest(folder)
    files = {**manifest.files, POPULATION: file_digest(folder / POPULATION)}
    write_manifest(replace(manifest, files=files), folder)
    return folder


def test_a_damaged_bundle_is_told_and_good_ones_still_come_and_go(shipped_bundles, tmp_path):
    log, models, (first, second) = StringIO(), tmp_path / "models", shipped_bundles[:2]
    shutil.copytree(first, models / "first")
    names = [read_manifest(bundle)[0].name for bundle in (first, second)]
    registry = load_registry(settings_for(tmp_path, models=(models,), threads=1))
    with running(served(tmp_path, registry, log)) as client:
        damaged(first, tmp_path / "new").rename(models / "damaged")
        until_broken(client, "damaged")
        shutil.copytree(second, tmp_path / "new").rename(models / "second")
        until_listed(client, *sorted(names))
        shutil.rmtree(models)
        until_listed(client)
    assert "broken model" in events(log)
    assert "models cannot be found anew" not in events(log)


def test_all_is_closed_though_one_part_cannot_be(tmp_path):
    ended, log = [], StringIO()
    app = app_for(tmp_path, log=log)

    def part(name, fault=None):
        ended.append(name)
        if fault is not None:
            raise fault

    @contextmanager
    def archives():
        yield
        part("archives", RuntimeError("an archive does not let go"))

    close = [lambda: part("first"), lambda: part("second", OSError("a database is away")), lambda: part("third")]

    async def lived():
        shared = {"services": app.state.services, "sweep": lambda: 0}
        async with lifespan(app, pacs=archives(), close=close, **shared):
            assert ended == []

    with pytest.raises(OSError, match="away"):
        asyncio.run(lived())
    assert ended == ["archives", "third", "second", "first"]
    assert events(log)[-1] == "stopped"


def test_results_that_cannot_be_swept_do_not_end_the_upkeep(tmp_path):
    app, log, turns = app_for(tmp_path, sweep_interval_s=0.01), StringIO(), []
    services = replace(app.state.services, log=make_log("info", log))

    def sweep():
        turns.append(1)
        if len(turns) < 3:
            raise PermissionError("the folder belongs to somebody else")
        return 1

    async def lived():
        async with lifespan(app, services=services, pacs=nothing(), sweep=sweep, close=()):
            await asyncio.to_thread(until, lambda: "expired results removed" in events(log))

    asyncio.run(lived())
    assert events(log).count("the results' folder cannot be swept") == 2


@contextmanager
def nothing():
    yield
