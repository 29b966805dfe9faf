"""What the use cases need of the outside, as small protocols, and the domain types that cross them."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import BinaryIO, Protocol, TypeVar

import numpy as np
from jaxtyping import Shaped

from model.bundle import ShapeModel
from model.geometry import Grid
from model.inference.mesh import Mesh
from model.inference.modes import ShapeModes
from model.inference.observations import MaskStack
from model.inference.reconstruction import Options, Reconstruction, Watch
from model.interruption import Check

T = TypeVar("T")
#: Kinds of jobs of the interface: bulk sampling, one reconstruction in the background, one for each mask of an archive.
SAMPLES_JOB, RECONSTRUCTION_JOB, RECONSTRUCTIONS_JOB = "samples", "reconstruction", "reconstructions"
#: A file as it came: its bytes, where it lies, or open for reading from its start.
MaskSource = bytes | Path | BinaryIO


class MeshFormat(StrEnum):
    """Mesh formats of the interface; the value is also the file suffix."""

    PLY = "ply"
    STL = "stl"
    OBJ = "obj"
    GLB = "glb"
    THREE_MF = "3mf"
    VTP = "vtp"
    MZ3 = "mz3"


class SampleFormat(StrEnum):
    """Formats of synthetic shapes: meshes, a label map, arrays, or a label map with a sparse drawing of it."""

    STL = "stl"
    PLY = "ply"
    OBJ = "obj"
    GLB = "glb"
    THREE_MF = "3mf"
    VTP = "vtp"
    MZ3 = "mz3"
    NIFTI = "nifti"
    NPZ = "npz"
    PAIRS = "pairs"


@dataclass(frozen=True)
class Outcome:
    """A reconstruction with what is needed to evaluate it later.

    Attributes:
        model_name, model_version, model_digest: of the model that made it.
        options: what the caller chose.
        grid: voxel grid of the first mask, "the input's grid".
        reconstruction: the answer.
    """

    model_name: str
    model_version: str
    model_digest: str
    options: Options
    grid: Grid
    reconstruction: Reconstruction


@dataclass(frozen=True)
class StoredResult:
    """An outcome in the store, with its random identifier and its time to live (UTC)."""

    id: str
    created: datetime
    expires: datetime
    outcome: Outcome


class Catalogue(Protocol):
    """The loaded models."""

    def names(self) -> tuple[str, ...]:
        """Names of the loaded models, in order."""
        ...

    def get(self, name: str | None) -> ShapeModel:
        """A model by name, or by ``name@version``; the only one when `name` is None.

        Raises:
            UnknownModel: no model of that name.
            InvalidParameter: no name, and not exactly one model.
        """
        ...


class ResultStore(Protocol):
    """Keeps outcomes for a limited time."""

    def save(self, outcome: Outcome, identifier: str | None = None) -> StoredResult:
        """Keep an outcome under a new random identifier, or under one that the caller drew.

        Raises:
            StoreFull: larger than everything that may be kept.
        """
        ...

    def load(self, identifier: str) -> StoredResult:
        """An outcome that has not expired.

        Raises:
            UnknownResult: never kept, expired or deleted.
            Overloaded: the storage does not answer, here and in what follows.
        """
        ...

    def has(self, identifier: str) -> bool:
        """Whether an outcome is kept and has not expired, without reading it."""
        ...

    def delete(self, identifier: str) -> None:
        """Forget an outcome at once.

        Raises:
            UnknownResult: never kept, expired or deleted.
        """
        ...


class MaskReader(Protocol):
    """One file to its mask stacks."""

    def __call__(self, data: MaskSource, part: str, labels: frozenset[int] | None) -> tuple[MaskStack, ...]:
        """Foreground are the voxels with one of the labels, all non-zero ones when None."""
        ...


class MeshWriter(Protocol):
    """A mesh to the bytes of a file."""

    def __call__(self, mesh: Mesh, format: str, *, space: str = "RAS", metadata: Mapping[str, object]) -> bytes:
        """The same mesh gives the same bytes."""
        ...


class VolumeWriter(Protocol):
    """A voxel array to the bytes of a NIfTI file."""

    def __call__(self, values: Shaped[np.ndarray, "i j k"], grid: Grid, description: str, /) -> bytes:
        """The same volume gives the same bytes; values are bytes or single precision."""
        ...


class Ticket(Protocol):
    """The right to have work done."""

    async def run(self, work: Callable[[], T]) -> T:
        """Result of the work, done by one of the engine's workers."""
        ...

    def aside(self) -> AbstractContextManager[None]:
        """While a client takes what was made, its place is another's; then it has one again, even one too many."""
        ...


class ModeSource(Protocol):
    """Modes of a model, found once."""

    def __call__(self, model: ShapeModel, /) -> ShapeModes:
        """The same model gives the same modes."""
        ...


class Compute(Protocol):
    """Calls a function of a model, in this process or in another one; as many at a time as there is room for."""

    def __call__(
        self, work: Callable[..., T], model: ShapeModel, *arguments: object, watch: Watch = ..., check: Check = ...
    ) -> T:
        """What ``work(model, *arguments, watch=watch, check=check)`` gives.

        Args:
            work: a function of a module, with arguments and a result that can be pickled.
            watch: told the name of each stage as it begins.
            check: called many times a second; what it raises ends the work.
        """
        ...


class WorkEngine(Protocol):
    """Workers with a bounded queue before them."""

    def admit(self) -> AbstractContextManager[Ticket]:
        """A place among running and waiting work.

        Raises:
            Overloaded: all places are taken.
        """
        ...

    def waiting(self) -> int:
        """How many tickets wait for a worker."""
        ...

    def running(self) -> int:
        """How many workers are busy."""
        ...

    def is_full(self) -> bool:
        """Whether `admit` would refuse."""
        ...
