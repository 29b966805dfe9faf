"""What all tests share: annotations checked at run time, real cohorts where they are, Hypothesis profiles."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook

from tests import runtime_types

# Before anything of the project is imported: from here on array shapes are checked at every call.
install_import_hook(["model", "training"], f"{runtime_types.__name__}.checked")

ROOT = Path(__file__).resolve().parents[1]

settings.register_profile("local", deadline=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", parent=settings.get_profile("local"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout."""
    return ROOT


@pytest.fixture
def keyboard() -> Iterator[None]:
    """Interrupts raise, as at a terminal; what is started in the background has them ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real cohorts beside the checkout; skips where it is not there."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no real cohorts beside the checkout (../shared/data)")
    return folder


@pytest.fixture(scope="session")
def shipped_bundles() -> tuple[Path, ...]:
    """Folders of the models that ship."""
    bundles = tuple(sorted(path.parent for path in (ROOT / "model" / "bundles").glob("*/manifest.json")))
    if not bundles:
        pytest.skip("no model ships with this checkout (model/bundles/*/manifest.json)")
    return bundles
