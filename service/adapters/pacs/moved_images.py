"""Where images arrive that an archive was asked to move (C-MOVE): one retrieval at a time on each port."""

import fcntl
import os
import ssl
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pynetdicom import evt

from service.adapters.pacs import sop_classes
from service.adapters.pacs.configuration import MoveDestination
from service.adapters.pacs.listening import ListeningEntity
from service.adapters.pacs.prompt_sockets import PROMPT

#: Associations in which an archive sends the images of one series at the same time.
MOST_ASSOCIATIONS = 10


@contextmanager
def receiving(
    target: MoveDestination, sender: str, handler: Callable[[Any], int], secure: ssl.SSLContext | None
) -> Iterator[None]:
    """The port is open for one calling title, and for nobody else; others on this machine wait until it is closed."""
    entity: Any = ListeningEntity(target.ae_title, [sender], MOST_ASSOCIATIONS)
    for uid in sop_classes.STORAGE:
        entity.add_supported_context(uid, list(sop_classes.IMAGE_SYNTAXES))
    handlers = [PROMPT, (evt.EVT_C_STORE, handler)]
    address = (target.host, target.port)
    with _alone_on(target.port):
        server = entity.start_server(address, block=False, ssl_context=secure, evt_handlers=handlers)
        try:
            yield
        finally:
            server.shutdown()


@contextmanager
def _alone_on(port: int) -> Iterator[None]:
    """Threads and processes of this machine in turn; the lock of a process that is killed is free at once."""
    path = Path(tempfile.gettempdir()) / f"morphoflow-{os.getuid()}-{port}.lock"
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(handle) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
