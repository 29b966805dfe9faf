"""Extras are those of the package, and one that is not there is told of."""

import sys
import tomllib

import pytest

from model.errors import InvalidParameter
from service.extras import EXTRAS, require_extra, require_extras
from service.settings import Settings
from service.stores import open_blobs


@pytest.mark.parametrize("extra", EXTRAS)
def test_modules_are_those_that_the_extra_brings(extra, repository):
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    brought = {line.split(">")[0].replace("-", "") for line in project["optional-dependencies"][extra]}
    assert {module.replace("_", "") for module in EXTRAS[extra]} == brought


def test_an_extra_that_is_there_is_accepted():
    require_extra("pacs", needed_by="This")


def test_settings_without_need_ask_for_nothing(monkeypatch):
    for module in (*EXTRAS["pacs"], *EXTRAS["cluster"]):
        monkeypatch.setitem(sys.modules, module, None)
    require_extras(Settings())
    bucket = Settings(storage_url="s3://bucket")
    for open_it in (require_extras, open_blobs):
        with pytest.raises(InvalidParameter, match="extra cluster"):
            open_it(bucket)
