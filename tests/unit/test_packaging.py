"""What an installation brings: declared dependencies, tested versions, shipped files."""

import ast
import re
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterable, Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from subprocess import run
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

#: Extras that a package may import from, beside the core.
EXTRAS = {"model": ("torch", "training"), "service": ("torch", "pacs", "demo", "cluster"), "training": ("training",)}

#: The same of folders that are no part of the wheel.
EXTRAS_BESIDE = {"benchmarks": ("bench",), "docs/examples": ("demo",), "tests": ("test",)}

#: What the page is built from does not ship.
PAGE_SOURCES = Path("service", "page", "source")


@pytest.fixture(scope="module")
def project(repository: Path) -> dict[str, Any]:
    return tomllib.loads((repository / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def constraints(repository: Path) -> dict[str, Version]:
    lines = (repository / "constraints.txt").read_text().splitlines()
    pins = (Requirement(line) for line in lines if line and not line.startswith("#"))
    return {canonicalize_name(pin.name): Version(str(pin.specifier).removeprefix("==")) for pin in pins}


def required(project: dict[str, Any], lines: Iterable[str]) -> Iterator[Requirement]:
    """Requirements, with those of the project's own extras in place of them."""
    for requirement in map(Requirement, lines):
        if requirement.name == project["name"]:
            for extra in requirement.extras:
                yield from required(project, project["optional-dependencies"][extra])
        else:
            yield requirement


def declared(project: dict[str, Any], *extras: str) -> dict[str, Requirement]:
    lines = [*project["dependencies"], *(line for extra in extras for line in project["optional-dependencies"][extra])]
    return {canonicalize_name(requirement.name): requirement for requirement in required(project, lines)}


def third_party_imports(folder: Path) -> Iterator[tuple[str, Path]]:
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            yield from ((name.partition(".")[0], path) for name in names)


@pytest.mark.parametrize("package", sorted(EXTRAS | EXTRAS_BESIDE))
def test_every_import_is_declared(package: str, project: dict[str, Any], repository: Path) -> None:
    folder = repository / package
    beside = {path.stem for path in folder.glob("*.py")} if package in EXTRAS_BESIDE else set()
    ours = set(sys.stdlib_module_names) | set(EXTRAS) | set(EXTRAS_BESIDE) | beside
    allowed = declared(project, *(EXTRAS | EXTRAS_BESIDE)[package])
    providers = packages_distributions()
    undeclared = {
        f"{name} in {path.relative_to(repository)}"
        for name, path in third_party_imports(folder)
        if name not in ours and not any(canonicalize_name(source) in allowed for source in providers.get(name, [name]))
    }
    assert not undeclared


def test_every_requirement_has_an_upper_bound(project: dict[str, Any]) -> None:
    for requirement in declared(project, *project["optional-dependencies"]).values():
        assert {bound.operator for bound in requirement.specifier} & {"<", "=="}, requirement


def test_constraints_hold_a_tested_version_for_every_requirement(
    project: dict[str, Any], constraints: dict[str, Version]
) -> None:
    for name, requirement in declared(project, *project["optional-dependencies"]).items():
        assert constraints[name] in requirement.specifier, f"constraints.txt pins {name} outside {requirement}"


def test_the_core_brings_no_torch(project: dict[str, Any]) -> None:
    assert "torch" not in declared(project)
    assert "torch" in declared(project, "training")


def test_version_stands_in_the_changelog(project: dict[str, Any], repository: Path) -> None:
    changelog = (repository / "CHANGELOG.md").read_text()
    assert re.search(rf"^## \[{re.escape(project['version'])}\]", changelog, re.MULTILINE)


@pytest.mark.slow
def test_wheel_holds_code_models_and_licence(tmp_path: Path, repository: Path) -> None:
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, repository]
    built = run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = tmp_path.glob("morphoflow-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    expected = {
        str(path.relative_to(repository))
        for folder in EXTRAS
        for path in (repository / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and not path.is_relative_to(repository / PAGE_SOURCES)
    }
    assert expected <= names
    assert {name.partition("/")[0] for name in names} - set(EXTRAS) == {wheel.name.rsplit("-py3", 1)[0] + ".dist-info"}
    assert {"LICENSE", "NOTICE"} <= {Path(name).name for name in names}
    assert not any(name.endswith((".pyc", ".pt")) for name in names - expected)


#: Collects what lies in the working folder, without the checkout that is installed.
COLLECTED = """
import sys
sys.path[:] = [place for place in sys.path if place != sys.argv[1]]
import pytest
sys.exit(pytest.main(["-q", "-p", "no:cacheprovider", "--collect-only", "tests"]))
"""


@pytest.mark.slow
def test_every_test_of_a_source_distribution_is_found_and_no_page_is_missing(tmp_path: Path, repository: Path) -> None:
    command = [sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", tmp_path, repository]
    built = run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    (source,) = tmp_path.glob("morphoflow-*.tar.gz")
    with tarfile.open(source) as archive:
        archive.extractall(tmp_path, filter="data")
    place = tmp_path / source.name.removesuffix(".tar.gz")
    collected = run(
        [sys.executable, "-c", COLLECTED, repository], cwd=place, capture_output=True, text=True, check=False
    )
    assert collected.returncode == 0, collected.stdout + collected.stderr
    assert missing_links(place) == []


def missing_links(root: Path) -> list[str]:
    pages = [*root.glob("*.md"), *(root / "docs").rglob("*.md")]
    links = [(page, link) for page in pages for link in re.findall(r"\]\(([^)#\s]+)", page.read_text())]
    return [f"{page.name}: {link}" for page, link in links if "://" not in link and not (page.parent / link).exists()]


def test_links_between_pages_lead_somewhere(repository: Path) -> None:
    assert missing_links(repository) == []
