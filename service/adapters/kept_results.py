"""What both stores of results have in common: how a result that is gone, too old or damaged is met."""

from collections.abc import Callable
from pathlib import Path

from service.adapters.archive import SUMMARY, moment, read_document, read_outcome
from service.errors import UnknownResult
from service.identifiers import is_identifier
from service.observability import Log, make_log
from service.ports import StoredResult


def unknown_result() -> UnknownResult:
    """What is said of a result that is not there, wherever results are kept."""
    return UnknownResult("There is no reconstruction of this identifier; it may have expired or been deleted.")


def checked(identifier: str) -> str:
    """The identifier, if a result may have it; `UnknownResult` otherwise."""
    if not is_identifier(identifier):
        raise unknown_result()
    return identifier


class ResultReader:
    """Reads results from folders, and tells of each damaged one once.

    Args:
        clock: seconds since 1970.
        log: standard error when None.
    """

    def __init__(self, clock: Callable[[], float], log: Log | None = None) -> None:
        self._clock = clock
        self._log = log or make_log("warning")
        self._told: set[str] = set()

    def read(self, identifier: str, folder: Path) -> StoredResult:
        """The result in a folder; `UnknownResult` when it is not there, has expired or is damaged."""
        try:
            return self._read(identifier, folder)
        except (OSError, ValueError) as fault:
            if (folder / SUMMARY).exists():  # else it was deleted meanwhile
                self.tell(identifier, fault)
            raise unknown_result() from None

    def tell(self, identifier: str, fault: Exception) -> None:
        """Log once that a result is damaged."""
        if identifier not in self._told:
            self._told.add(identifier)
            self._log.error("damaged result", result=identifier, kind=type(fault.__cause__ or fault).__name__)

    def _read(self, identifier: str, folder: Path) -> StoredResult:
        document = read_document(folder)
        if document["expires"] <= self._clock():
            raise unknown_result()
        outcome = read_outcome(folder, document)
        return StoredResult(identifier, moment(document["created"]), moment(document["expires"]), outcome)
