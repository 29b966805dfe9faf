"""The web process among archives, wired from its settings: the listener and the receiver."""

import logging
import warnings
from contextlib import ExitStack
from pathlib import Path
from threading import Lock

from service.adapters.pacs.audit import AuditEntry, AuditEvent, AuditTrail
from service.adapters.pacs.commitment import Reports
from service.adapters.pacs.configuration import PacsConfiguration, load_configuration
from service.adapters.pacs.dimse_server import PeerDesk, dimse_listener
from service.adapters.pacs.inbox import Inbox
from service.job_ports import BlobStore, JobEngine
from service.observability import Log
from service.settings import Settings

#: Loggers of libraries that write values of headers.
TALKATIVE = ("pydicom", "pynetdicom", "highdicom", "dicomweb_client", "urllib3")
#: Title in the audit trail of a service that does not listen for DIMSE.
PROGRAM = "MORPHOFLOW"


class Tally:
    """A count that several threads add to."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._count = 0

    def add(self) -> None:
        """One more."""
        with self._lock:
            self._count += 1

    def count(self) -> int:
        """How many there were."""
        return self._count


class Pacs:
    """The parts of the web process; while the context lasts, associations are accepted if the file asks for it.

    Attributes:
        inbox: takes objects.
        turned_away: how many associations were one too many.
    """

    def __init__(self, configuration: PacsConfiguration, inbox: Inbox, log: Log) -> None:
        self.inbox = inbox
        self.turned_away = Tally()
        self._listener = configuration.listener
        self._log = log
        self._scope = ExitStack()

    def __enter__(self) -> "Pacs":
        inbox = self.inbox
        inbox.take_up()
        inbox.audit.write(AuditEntry(AuditEvent.STARTED, inbox.title, inbox.title))
        self._scope.callback(inbox.audit.write, AuditEntry(AuditEvent.STOPPED, inbox.title, inbox.title))
        if self._listener is not None:
            title, reports = self._listener.ae_title, Reports(inbox.blobs)
            desk = PeerDesk(title, inbox, reports, inbox.audit, self._log, self.turned_away.add)
            self._scope.enter_context(dimse_listener(self._listener, desk))
        return self

    def __exit__(self, *_: object) -> None:
        self._scope.close()


def open_pacs(settings: Settings, file: Path, blobs: BlobStore, jobs: JobEngine, log: Log) -> Pacs:
    """The parts of the web process, as the file says.

    Raises:
        InvalidParameter: the file cannot be used.
    """
    silence_libraries()
    configuration = load_configuration(file)
    inbox = Inbox(configuration.rules, blobs, jobs, audit_trail(configuration, settings), title_of(configuration), log)
    return Pacs(configuration, inbox, log)


def silence_libraries() -> None:
    """Nothing that a library would log or warn of leaves the process: it holds values of headers."""
    warnings.filterwarnings("ignore", module=r"(pydicom|pynetdicom|highdicom|dicomweb_client|service)\b")
    for name in TALKATIVE:
        logger = logging.getLogger(name)
        logger.addHandler(logging.NullHandler())
        logger.propagate = False


def title_of(configuration: PacsConfiguration) -> str:
    """Name of this service in the audit trail."""
    return PROGRAM if configuration.listener is None else configuration.listener.ae_title


def audit_trail(configuration: PacsConfiguration, settings: Settings) -> AuditTrail:
    """The trail in the file of the configuration, or beside the results."""
    beside: Path = settings.results_folder.parent / "audit.jsonl"
    return AuditTrail(configuration.audit_file or beside)
