"""What lies in a folder, as it can be seen from outside: to say that it stayed as it was."""

import hashlib
import os
import stat
from pathlib import Path

Entry = tuple[int, int, int, int, str, tuple[str, ...]]


def fingerprint(folder: str | Path) -> dict[str, Entry]:
    """Mode, owner, links, time of change, content and attributes of all that is in a folder."""
    root = Path(folder)
    return {str(path.relative_to(root)): _entry(path) for path in [root, *root.rglob("*")]}


def _entry(path: Path) -> Entry:
    status = path.lstat()
    content = hashlib.sha256(path.read_bytes()).hexdigest() if stat.S_ISREG(status.st_mode) else ""
    names = tuple(os.listxattr(path, follow_symlinks=False))
    return status.st_mode, status.st_uid, status.st_nlink, status.st_mtime_ns, content, names
