"""The commands of the training, and masks for them."""

import pytest
import typer
from typer.testing import CliRunner

from tests.cohort_parts import egg, write
from training.cli import register


@pytest.fixture
def masks(tmp_path):
    for n in range(7):
        write(tmp_path / "masks" / ("test" if n == 6 else "train"), f"e{n}", egg(n))
    return tmp_path / "masks"


@pytest.fixture(scope="session")
def run():
    app = typer.Typer()
    register(app)

    def call(*words):
        return CliRunner().invoke(app, [str(word) for word in words])

    return call
