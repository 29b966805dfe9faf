"""The models of a service: the shipped ones and those of further folders.

A model that cannot be opened is kept with its sentence and does not stop the others.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from model.bundle import ShapeModel, open_bundle
from model.errors import BundleError, InvalidParameter, UnknownModel
from service.settings import Settings

MANIFEST = "manifest.json"


@dataclass(frozen=True)
class BrokenModel:
    """A bundle that could not be opened: its folder's last name, and why."""

    name: str
    reason: str


class ModelRegistry:
    """The `Catalogue` of models in memory."""

    def __init__(self, models: Mapping[str, ShapeModel], broken: Iterable[BrokenModel] = ()) -> None:
        self._models = dict(models)
        self.broken = tuple(broken)

    def names(self) -> tuple[str, ...]:
        """Names of the loaded models, in order."""
        return tuple(sorted(self._models))

    def get(self, name: str | None) -> ShapeModel:
        """A model by name; the only one when `name` is None."""
        if name is None:
            return self._only()
        if name not in self._models:
            raise UnknownModel(f"No loaded model has this name; loaded are: {', '.join(self.names()) or 'none'}.")
        return self._models[name]

    def _only(self) -> ShapeModel:
        if len(self._models) != 1:
            loaded = ", ".join(self.names()) or "none"
            raise InvalidParameter(f"The parameter model must name one of the loaded models: {loaded}.", part="model")
        return next(iter(self._models.values()))


def load_models(folders: Iterable[Path], open_model: Callable[[Path], ShapeModel]) -> ModelRegistry:
    """Open every bundle of the folders; of two with one name the first stays."""
    models: dict[str, ShapeModel] = {}
    broken: list[BrokenModel] = []
    for folder in folders:
        try:
            model = open_model(folder)
        except (BundleError, OSError) as fault:
            reason = str(fault) if isinstance(fault, BundleError) else "The bundle's folder cannot be read."
            broken.append(BrokenModel(folder.name, reason))
            continue
        if model.manifest.name in models:
            broken.append(BrokenModel(folder.name, f"Another bundle is called {model.manifest.name} as well."))
        else:
            models[model.manifest.name] = model
    return ModelRegistry(models, broken)


def load_registry(settings: Settings) -> ModelRegistry:
    """The registry that the settings ask for."""
    shipped = (Path(str(resources.files("model"))) / "bundles",) if settings.shipped_models else ()
    folders = [bundle for root in (*shipped, *settings.models) for bundle in find_bundles(root)]
    return load_models(folders, lambda folder: open_bundle(folder, backend=settings.backend, threads=settings.threads))


def find_bundles(root: Path) -> Iterator[Path]:
    """The folder itself when it is a bundle, else the folders in it; nothing when it is not there."""
    if (root / MANIFEST).is_file():
        yield root
    elif root.is_dir():
        yield from sorted(folder for folder in root.iterdir() if folder.is_dir() and not folder.name.startswith("."))
