"""Random networks, exported once."""

import pytest

from tests.random_networks import Exported, export_random


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """A bundle of random networks; not to be written to."""
    return export_random(tmp_path_factory.mktemp("exported"))
