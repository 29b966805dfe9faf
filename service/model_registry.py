"""The models of a service: the shipped ones and those of further folders, found again while it runs.

A model that cannot be opened is kept with its sentence and does not stop the others. Several versions of one model
stand side by side: ``name`` is the newest one, ``name@version`` a certain one.
"""

import errno
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from packaging.version import InvalidVersion, Version

from model.bundle import MANIFEST, ShapeModel, open_bundle
from model.errors import BundleError, InvalidParameter, UnknownModel
from service.settings import Settings

#: Between a model's name and its version.
AT = "@"


@dataclass(frozen=True)
class BrokenModel:
    """A bundle that could not be opened, or a folder of bundles that is not there: its last name, and why."""

    name: str
    reason: str


class ModelRegistry:
    """The `Catalogue` of models in memory.

    Args:
        models: by name, or by name and version.
        broken: what could not be opened.
        reload: finds both anew.
    """

    def __init__(
        self,
        models: Mapping[str, ShapeModel],
        broken: Iterable[BrokenModel] = (),
        reload: "Callable[[], ModelRegistry] | None" = None,
    ) -> None:
        pinned = {pinned_name(model): model for model in models.values()}
        self._models = {**pinned, **_newest(pinned.values()), **models}
        self._reload = reload
        self.broken = tuple(broken)

    def names(self) -> tuple[str, ...]:
        """Names of the loaded models, in order."""
        return tuple(sorted(name for name in self._models if AT not in name))

    def get(self, name: str | None) -> ShapeModel:
        """A model by name, or by name and version; the only one when `name` is None."""
        models = self._models
        if name is None:
            return self._only()
        if name not in models:
            raise self._unknown(name)
        return models[name]

    def of_digest(self, digest: str) -> ShapeModel | None:
        """The model of these contents, of any version."""
        return next((model for model in self._models.values() if model.digest == digest), None)

    def refresh(self) -> bool:
        """Load what is new and drop what is gone; requests that run keep their model. Whether anything changed."""
        if self._reload is None:
            return False
        found = self._reload()
        changed = _digests(found._models) != _digests(self._models) or found.broken != self.broken
        self._models, self.broken = found._models, found.broken
        return changed

    def _unknown(self, name: str) -> UnknownModel:
        """What to tell of a name that no model has: the versions of a model that is loaded in others, else all."""
        base, _, _ = name.partition(AT)
        versions = sorted((pinned for pinned in self._models if pinned.startswith(f"{base}{AT}")), key=_order)
        if base in self._models and versions:
            return UnknownModel(f"This model is not loaded in this version; loaded are: {', '.join(versions)}.")
        return UnknownModel(f"No loaded model has this name; loaded are: {', '.join(self.names()) or 'none'}.")

    def _only(self) -> ShapeModel:
        names = self.names()
        if len(names) != 1:
            loaded = ", ".join(names) or "none"
            raise InvalidParameter(f"The parameter model must name one of the loaded models: {loaded}.", part="model")
        return self._models[names[0]]


def pinned_name(model: ShapeModel) -> str:
    """``name@version``, which names the same model for ever."""
    return f"{model.manifest.name}{AT}{model.manifest.version}"


def load_models(folders: Iterable[Path], open_model: Callable[[Path], ShapeModel]) -> ModelRegistry:
    """Open every bundle of the folders; of two with one name and version the first stays.

    Raises:
        OSError: this process has no more files to open, of which no bundle is the cause.
    """
    models: dict[str, ShapeModel] = {}
    broken: list[BrokenModel] = []
    for folder in folders:
        try:
            model = open_model(folder)
        except (BundleError, OSError) as fault:
            broken.append(_broken(folder, _reason(fault)))
            continue
        name = pinned_name(model)
        if name in models:
            broken.append(_broken(folder, f"Another bundle is called {name} as well."))
        else:
            models[name] = model
    return ModelRegistry(models, broken)


def _reason(fault: BundleError | OSError) -> str:
    if isinstance(fault, BundleError):
        return str(fault)
    if fault.errno in (errno.EMFILE, errno.ENFILE):
        raise fault
    return "The bundle's folder cannot be read."


def load_registry(settings: Settings) -> ModelRegistry:
    """The registry that the settings ask for."""
    shipped = (Path(str(resources.files("model"))) / "bundles",) if settings.shipped_models else ()
    once = OpenedOnce(lambda folder: open_bundle(folder, backend=settings.backend, threads=settings.threads))

    def load() -> ModelRegistry:
        bundles = [bundle for root in (*shipped, *settings.models) for bundle in find_bundles(root)]
        found = load_models(bundles, once)
        once.forget_all_but(bundles)
        return ModelRegistry(found._models, (*found.broken, *absent_folders(settings.models)))

    found = load()
    return ModelRegistry(found._models, found.broken, load)


class OpenedOnce:
    """Opens a bundle when it is new or its manifest, which holds the hashes of all of its files, has changed."""

    def __init__(self, open_model: Callable[[Path], ShapeModel]) -> None:
        self._open = open_model
        self._opened: dict[Path, tuple[bytes, ShapeModel]] = {}

    def __call__(self, folder: Path) -> ShapeModel:
        """The model of a folder."""
        manifest = folder / MANIFEST
        content = manifest.read_bytes() if manifest.is_file() else b""
        if folder not in self._opened or self._opened[folder][0] != content:
            self._opened.pop(folder, None)  # one that cannot be opened any more takes no memory
            self._opened[folder] = content, self._open(folder)
        return self._opened[folder][1]

    def forget_all_but(self, folders: Collection[Path]) -> None:
        """Let go of the models of folders that are gone."""
        for folder in self._opened.keys() - set(folders):
            del self._opened[folder]


def find_bundles(root: Path) -> list[Path]:
    """The folder itself when it is a bundle, else the folders in it; none when it is not there or cannot be read."""
    try:
        if (root / MANIFEST).is_file():
            return [root]
        return sorted(folder for folder in root.iterdir() if folder.is_dir() and not folder.name.startswith("."))
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return []


def absent_folders(roots: Iterable[Path]) -> Iterator[BrokenModel]:
    """What stands for the folders that are named and not there, cannot be read, or are no folders."""
    for root in roots:
        if not os.access(root, os.R_OK | os.X_OK) or not root.is_dir():
            yield _broken(root, "MORPHOFLOW_MODELS names this folder, and there is none to read of this name.")


def _broken(folder: Path, reason: str) -> BrokenModel:
    """With text that can be sent: names of folders may hold bytes that are no letters."""
    return BrokenModel(*(text.encode("utf-8", "replace").decode() for text in (folder.name, reason)))


def _newest(models: Iterable[ShapeModel]) -> dict[str, ShapeModel]:
    return {model.manifest.name: model for model in sorted(models, key=lambda model: _order(model.manifest.version))}


def _order(version: str) -> tuple[Version, str]:
    """By the rules of Python packages: what comes before a release is older; of other texts their numbers count."""
    try:
        return Version(version), version
    except InvalidVersion:
        return Version(".".join(re.findall(r"[0-9]+", version)) or "0"), version


def _digests(models: Mapping[str, ShapeModel]) -> dict[str, str]:
    return {name: model.digest for name, model in models.items()}
