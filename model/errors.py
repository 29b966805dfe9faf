"""The error tree.

::

    MorphoFlowError
    ├── InputError                 the caller's input is at fault; `part` names the offending part
    │   ├── UnreadableImage        not an image, or an image that ends too early
    │   ├── InvalidGeometry        affine or spacing that no voxel grid can have
    │   ├── InvalidMask            readable, but not a sparse segmentation
    │   ├── InconsistentStacks     several stacks that cannot be of one object
    │   ├── InvalidParameter       a value out of its range
    │   └── TooLarge               over a configured limit
    ├── NotFound                   `what` is not here
    │   ├── UnknownModel
    │   └── UnknownMode            no mode of this rank
    ├── BundleError                an exported model that cannot be trusted
    │   ├── BundleIncomplete       a file is missing
    │   ├── BundleCorrupt          a file differs from its recorded SHA-256, or cannot be parsed
    │   └── BundleTooNew           written by a later format than this program reads
    ├── ParityError                exported graphs disagree with the network they came from
    └── CohortError                training data that must not be trained on

Not converging is an answer with a status, not an error.
Every message is one sentence that names the offending part and says what would be accepted;
none holds a path, a file name or an identifier from an image header.
"""


class MorphoFlowError(Exception):
    """Base of all errors raised on purpose by this project."""


class InputError(MorphoFlowError):
    """The caller's input is at fault.

    Args:
        message: one sentence: what is wrong and what would be accepted.
        part: the offending part as the caller knows it, for example ``mask[1]`` or ``resolution_mm``.
    """

    def __init__(self, message: str, *, part: str) -> None:
        super().__init__(message)
        self.part = part


class UnreadableImage(InputError):
    """The bytes are not an image of a supported format, or end too early."""


class InvalidGeometry(InputError):
    """Affine or spacing that no voxel grid can have: zero, non-finite, sheared, not invertible."""


class InvalidMask(InputError):
    """A readable image that is not a usable sparse segmentation."""


class InconsistentStacks(InputError):
    """Several stacks, or several planes, that cannot be of one object."""


class InvalidParameter(InputError):
    """A parameter's value lies outside its range."""


class TooLarge(InputError):
    """More bytes, voxels or items than the configured limit."""


class NotFound(MorphoFlowError):
    """Something asked for by name or id is not here."""


class UnknownModel(NotFound):
    """No loaded model carries this name."""


class UnknownMode(NotFound):
    """The model has no mode of this rank."""


class BundleError(MorphoFlowError):
    """An exported model that cannot be trusted."""


class BundleIncomplete(BundleError):
    """A file named by the manifest is missing."""


class BundleCorrupt(BundleError):
    """A file differs from the SHA-256 in the manifest, or the manifest cannot be parsed."""


class BundleTooNew(BundleError):
    """The bundle was written in a later format than this program reads."""


class ParityError(MorphoFlowError):
    """Exported graphs disagree with the network they were exported from."""


class CohortError(MorphoFlowError):
    """Training data that must not be trained on; the message lists each refused case and why."""
