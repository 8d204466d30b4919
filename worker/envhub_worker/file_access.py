"""Explains why a file could not be read or written: this process lacks the right, or it is missing.

The import system reports both as missing; and a jail may only read files that it shares.
"""

from __future__ import annotations

import errno
import os
import stat
import sys

_PACKAGES = "the packages"
_REFUSALS = (errno.EACCES, errno.EPERM, errno.EROFS)


def why_file_hidden(module: str) -> str:
    """Explains why an existing module may not be found; empty if no permission hides it.
    ``module``: its dotted name, as in ``ModuleNotFoundError.name``.
    """
    parent, _, last = module.rpartition(".")
    package = sys.modules.get(parent) if parent else None
    folders = sys.path if package is None else getattr(package, "__path__", ())
    steps = module.split(".") if package is None else [last]
    for folder in folders:
        depths = range(len(steps) + 1)
        places = [os.path.join(str(folder) or ".", *steps[:depth]) for depth in depths]
        for place in (*places, *(f"{place}.py" for place in places[1:])):
            closed = _closed(place)
            if closed:
                return closed
    return ""


def _closed(path: str) -> str:
    """Describes the file or folder, with owner and mode, that keeps this process from reading a
    path; empty if none does.
    """
    try:
        status = os.stat(path)
    except PermissionError:
        above = os.path.dirname(path)
        return _closed(above) or f"{path} may not be read by uid {os.geteuid()}"
    except OSError:
        return ""
    wanted = os.R_OK | os.X_OK if stat.S_ISDIR(status.st_mode) else os.R_OK
    if os.access(path, wanted):
        return ""
    return (
        f"{path} may not be read by uid {os.geteuid()}: it belongs to uid {status.st_uid} and has "
        f"mode {stat.S_IMODE(status.st_mode):04o}. What is missing may be installed there; if all "
        f"users may read it: chmod -R a+rX {path}"
    )


def why_file_unwritable(error: BaseException, root: str) -> str:
    """Explains an error about a file that a jail shares; empty for other errors."""
    name = getattr(error, "filename", None)
    if not isinstance(error, OSError) or error.errno not in _REFUSALS:
        return ""
    if not isinstance(name, (str, os.PathLike)):
        return ""
    path = os.path.abspath(os.fsdecode(name))
    place = _place(path, root)
    if not place or os.access(path, os.W_OK):
        return ""
    folder = os.path.dirname(path)
    makes_files = os.access(folder, os.W_OK | os.X_OK)
    if os.path.exists(path) and makes_files and not os.statvfs(folder).f_flag & os.ST_RDONLY:
        return (
            f"{path} is shared and has mode {os.stat(path).st_mode & 0o777:04o}. os.replace() puts "
            "another file there, and os.chmod(path, 0o755) makes it this jail's own, to be written "
            "or run: the Hub does not say which of its files are programs"
        )
    cure = (
        'use profile "strict" on Linux 5.11 or later, where a jail writes to its own copy of the '
        "repository and of its packages; `envhub doctor` says what this host lacks"
    )
    if place == _PACKAGES and _within(path, sys.prefix):  # an interpreter's, which others share
        cure = (
            f"give it packages of its own, with dependencies={{'extra': [{_distribution(path)!r}]}}"
        )
    return (
        f"{path} is in {place}, which is read-only in this jail. Write to tempfile.mkdtemp(), or "
        f"{cure}"
    )


def why_no_terminal(error: BaseException) -> str:
    """Explains an error about a pseudo terminal, which does not name it; empty for other errors."""
    name = str(getattr(error, "filename", ""))
    asked = name.startswith(("/dev/ptmx", "/dev/tty")) or "pty devices" in str(error)
    if not isinstance(error, OSError) or not asked:
        return ""
    return (
        'A jail of profile "strict" has at most 64 pseudo terminals, one of another profile has '
        "none; /dev/tty is the one that pty.fork() gave the process"
    )


def _place(path: str, root: str) -> str:
    if root and _within(path, root):
        return "the repository"
    return _PACKAGES if any(_within(path, folder) for folder in sys.path if folder) else ""


def _distribution(path: str) -> str:
    """Returns the distribution that installed the package of a file, or the package's name."""
    from importlib import metadata  # a server and its zygote start without: 20 ms

    folder = max((one for one in sys.path if one and _within(path, one)), key=len)
    package = os.path.relpath(path, folder).split(os.sep)[0]
    return metadata.packages_distributions().get(package, [package])[0]


def _within(path: str, folder: str) -> bool:
    return path.startswith(os.path.abspath(folder).rstrip(os.sep) + os.sep)
