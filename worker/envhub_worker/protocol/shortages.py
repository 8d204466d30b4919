"""What an operating system refuses since there is no more of it, and what to do about it."""

from __future__ import annotations

import errno

_SPACE = "free space, or remove files where only their number is used up (df -h; df -i)"
_CURES = {
    errno.EMFILE: "raise the limit on open files (ulimit -n; of a service LimitNOFILE=)",
    errno.ENFILE: "raise the machine's limit on open files (sysctl fs.file-max)",
    errno.ENOSPC: _SPACE,
    errno.EDQUOT: _SPACE,
    errno.EFBIG: "raise the limit on the size of a file (ulimit -f)",
    errno.ENOMEM: "free memory, or raise the limit on it",
}


def shortage(error: BaseException, where: str) -> str:
    """What is used up, where, and what to do; empty for an error of another kind.

    Args:
        error: An OSError, or ZeroMQ's error of the same form.
        where: ``"here"`` or ``"on the server"``.
    """
    cure = _CURES.get(getattr(error, "errno", None) or 0)
    if cure is None:
        return ""
    name = getattr(error, "filename", None)
    file = f" ({name})" if name else ""
    return f"{getattr(error, 'strerror', error)}{file} {where}: {cure}"
