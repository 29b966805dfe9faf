"""How a disk without room is told from other failures of the medium."""

import errno


def is_full(fault: BaseException) -> bool:
    """Whether a disk has no room, or somebody's share of it is used up."""
    return isinstance(fault, OSError) and fault.errno in (errno.ENOSPC, errno.EDQUOT)
