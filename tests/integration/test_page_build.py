"""What the service serves as its page is what its sources build."""

import filecmp
import gzip
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

EXAMPLE = Path("docs", "examples", "hippocampus_three_slices.nii.gz")
LARGEST_COMPRESSED = 1_200_000


@pytest.fixture(scope="module")
def page(repository):
    return repository / "service" / "page"


def names(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_the_sources_build_what_is_served(repository, page, tmp_path):
    modules = repository / "build" / "page" / "node_modules"
    if shutil.which("npm") is None or not modules.is_dir():
        pytest.skip("the page is not built here (Node, and once: make page)")
    shutil.copytree(page / "source", tmp_path / "source")
    (tmp_path / "source" / "node_modules").symlink_to(modules)
    command = ["npm", "run", "build", "--", "--outDir", str(tmp_path / "built")]
    built = subprocess.run(command, cwd=tmp_path / "source", capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    assert names(tmp_path / "built") == names(page / "built")
    for name in names(page / "built"):
        assert filecmp.cmp(tmp_path / "built" / name, page / "built" / name, shallow=False), f"make page: {name}"


def test_the_page_is_small(page):
    files = [page / "built" / name for name in names(page / "built")]
    assert sum(len(gzip.compress(file.read_bytes())) for file in files) < LARGEST_COMPRESSED


def test_the_pages_example_is_the_shipped_one(repository, page):
    assert (page / "built" / "page" / "example_hippocampus.nii.gz").read_bytes() == (repository / EXAMPLE).read_bytes()


def test_versions_are_pinned_and_name_no_host(page):
    lock = json.loads((page / "source" / "package-lock.json").read_text())
    wanted = json.loads((page / "source" / "package.json").read_text())
    for name, version in {**wanted["dependencies"], **wanted["devDependencies"]}.items():
        assert re.fullmatch(r"\d+\.\d+\.\d+", version)
        assert lock["packages"][f"node_modules/{name}"]["version"] == version
    assert all("resolved" not in package for package in lock["packages"].values())


def test_words_stand_in_one_file(page):
    spoken = re.compile(r"""['"`][A-Z][a-z]+ [a-z]+[^'"`]*['"`]""")
    found = {
        path.name
        for path in (page / "source" / "src").rglob("*.ts")
        if path.name != "text.ts" and spoken.search(re.sub(r"//.*|/\*\*.*?\*/", "", path.read_text(), flags=re.DOTALL))
    }
    assert found == set()
