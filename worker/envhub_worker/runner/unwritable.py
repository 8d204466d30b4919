"""Tells why a file of the repository or of its packages could not be written, and what helps."""

from __future__ import annotations

import errno
import os
import sys

_REFUSALS = (errno.EACCES, errno.EPERM, errno.EROFS)


def why_unwritable(error: BaseException, root: str) -> str:
    """A sentence for an error whose file lies among what a jail shares; empty for any other."""
    name = getattr(error, "filename", None)
    if not isinstance(error, OSError) or error.errno not in _REFUSALS or type(name) is not str:
        return ""
    path = os.path.abspath(name)
    place = _place(path, root)
    if not place or os.access(path, os.W_OK):
        return ""
    if os.path.exists(path) and not _is_read_only(path):
        return (
            f"{path} is shared and has mode {os.stat(path).st_mode & 0o777:04o}. os.replace() puts "
            "another file there, and os.chmod(path, 0o644) makes it this jail's own"
        )
    return (
        f"{path} lies in {place}, which this jail only reads. Write to tempfile.mkdtemp(), or use "
        'the profile "strict" on Linux 5.11 or later, where a jail writes to a copy of the '
        "repository and of the packages of its own (dependencies=); `envhub doctor` says what this "
        "host lacks"
    )


def _place(path: str, root: str) -> str:
    if root and _within(path, root):
        return "the repository"
    return "the packages" if any(_within(path, folder) for folder in sys.path if folder) else ""


def _within(path: str, folder: str) -> bool:
    return path.startswith(os.path.abspath(folder).rstrip(os.sep) + os.sep)


def _is_read_only(path: str) -> bool:
    """Whether nothing in the file's folder can be made or removed."""
    folder = os.path.dirname(path)
    read_only = os.statvfs(folder).f_flag & os.ST_RDONLY
    return bool(read_only) or not os.access(folder, os.W_OK | os.X_OK)
