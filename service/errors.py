"""Errors of the service, and the one table from error to problem (RFC 9457).

::

    MorphoFlowError
    └── ServiceError
        ├── Overloaded             more work is waiting than allowed
        ├── HelperLost             a process that computed an answer ended
        ├── StoreFull              a result larger than everything that may be kept
        ├── Unauthorised           no key, or a wrong one
        ├── NotAcceptable          none of the accepted media types can be made
        ├── UnsupportedMediaType   the body's media type is not read
        ├── ArchiveUnavailable     a picture archive cannot be reached; worth trying again
        ├── ArchiveRefused         a picture archive does not take a request; not worth trying again
        ├── Abandoned              the client went away while its work was done
        ├── Cancelled              nobody wants the job any more
        ├── GivenUp                a part of a job that ends its worker again and again
        └── NotReady               a job without a result: not done yet, failed or cancelled
    NotFound
    ├── UnknownJob                 never enqueued, or expired
    ├── UnknownResult              never kept, expired or deleted
    └── NotComputed                a part of a result that was not asked for when it was made
"""

from dataclasses import dataclass

from model.errors import (
    BundleCorrupt,
    BundleError,
    BundleIncomplete,
    BundleTooNew,
    CohortError,
    InconsistentStacks,
    InputError,
    InvalidGeometry,
    InvalidMask,
    InvalidParameter,
    MorphoFlowError,
    NotFound,
    ParityError,
    TooLarge,
    UnknownMode,
    UnknownModel,
    UnreadableImage,
)


class ServiceError(MorphoFlowError):
    """Base of errors that only a service has."""


class Overloaded(ServiceError):
    """More work is waiting than allowed."""


class HelperLost(ServiceError):
    """A process that computed an answer ended, for example for want of memory."""


class StoreFull(ServiceError):
    """A result larger than everything that may be kept."""


class Unauthorised(ServiceError):
    """No key, or a wrong one."""


class NotAcceptable(ServiceError):
    """None of the accepted media types can be made."""


class UnsupportedMediaType(ServiceError):
    """The body's media type is not read."""


class Abandoned(ServiceError):
    """The client went away while its work was done."""


class Cancelled(ServiceError):
    """Nobody wants the job any more."""


class GivenUp(ServiceError):
    """A part of a job that ends its worker again and again."""


class NotReady(ServiceError):
    """A job without a result: not done yet, failed or cancelled.

    Args:
        message: one sentence.
        cause: the kind of problem that a job failed of; None otherwise.
    """

    def __init__(self, message: str, cause: "Kind | None" = None) -> None:
        super().__init__(message)
        self.cause = cause


class UnknownJob(NotFound):
    """Never enqueued, or expired."""


class ArchiveUnavailable(ServiceError):
    """A picture archive cannot be reached, or cannot answer now; the same request may succeed later."""


class ArchiveRefused(ServiceError):
    """A picture archive does not take a request, and would not take it later."""


class UnknownResult(NotFound):
    """Never kept, expired or deleted."""


class NotComputed(NotFound):
    """A part of a result that was not asked for when it was made."""


@dataclass(frozen=True)
class Kind:
    """A kind of problem: its HTTP status, its stable name and its title."""

    status: int
    name: str
    title: str

    @property
    def type(self) -> str:
        """The stable `type` member of the problem."""
        return f"urn:morphoflow:problem:{self.name}"


#: Every error class of the program and the problem that a client sees.
KINDS: dict[type[MorphoFlowError], Kind] = {
    InputError: Kind(422, "invalid-input", "The input cannot be used"),
    UnreadableImage: Kind(415, "unreadable-image", "Not a readable image"),
    InvalidGeometry: Kind(422, "invalid-geometry", "The voxel grid is not valid"),
    InvalidMask: Kind(422, "invalid-mask", "Not a usable sparse segmentation"),
    InconsistentStacks: Kind(422, "inconsistent-stacks", "The stacks or planes do not match"),
    InvalidParameter: Kind(422, "invalid-parameter", "A parameter is not valid"),
    TooLarge: Kind(413, "too-large", "Larger than the limit"),
    NotFound: Kind(404, "not-found", "Not found"),
    UnknownModel: Kind(404, "unknown-model", "Unknown model"),
    UnknownMode: Kind(404, "unknown-mode", "Unknown mode"),
    UnknownResult: Kind(404, "unknown-result", "Unknown result"),
    UnknownJob: Kind(404, "unknown-job", "Unknown job"),
    NotComputed: Kind(404, "not-computed", "Not part of this result"),
    Overloaded: Kind(503, "overloaded", "Too much work is waiting"),
    HelperLost: Kind(503, "computation-lost", "The computation was lost"),
    StoreFull: Kind(507, "store-full", "No room for the result"),
    Unauthorised: Kind(401, "unauthorised", "A key is needed"),
    NotAcceptable: Kind(406, "not-acceptable", "No acceptable media type"),
    UnsupportedMediaType: Kind(415, "unsupported-media-type", "Media type not supported"),
    Abandoned: Kind(499, "abandoned", "The client went away"),
    NotReady: Kind(409, "not-ready", "The job has no result"),
    Cancelled: Kind(409, "cancelled", "The job was cancelled"),
    GivenUp: Kind(500, "internal-error", "Internal error"),
    ArchiveUnavailable: Kind(500, "internal-error", "Internal error"),
    ArchiveRefused: Kind(500, "internal-error", "Internal error"),
    BundleError: Kind(500, "internal-error", "Internal error"),
    BundleIncomplete: Kind(500, "internal-error", "Internal error"),
    BundleCorrupt: Kind(500, "internal-error", "Internal error"),
    BundleTooNew: Kind(500, "internal-error", "Internal error"),
    ParityError: Kind(500, "internal-error", "Internal error"),
    CohortError: Kind(500, "internal-error", "Internal error"),
    ServiceError: Kind(500, "internal-error", "Internal error"),
    MorphoFlowError: Kind(500, "internal-error", "Internal error"),
}

#: Problems that the HTTP layer finds by itself, by status.
PROTOCOL_KINDS: dict[int, Kind] = {
    400: Kind(400, "malformed-request", "The request cannot be parsed"),
    404: Kind(404, "not-found", "Not found"),
    405: Kind(405, "method-not-allowed", "Method not allowed"),
    500: Kind(500, "internal-error", "Internal error"),
}


def kind_of(error: MorphoFlowError) -> Kind:
    """The kind of an error: its own class's, or its nearest parent's."""
    return next(KINDS[parent] for parent in type(error).__mro__ if parent in KINDS)
