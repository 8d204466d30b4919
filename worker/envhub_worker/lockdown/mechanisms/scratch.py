"""A jail's writable folders: home, temporary files, and a working view of its snapshot."""

from __future__ import annotations

import contextlib
import os
import secrets
import stat

from envhub_worker.lockdown.root_plan import HOME, SHARED_MEMORY, TEMPORARY, WORK
from envhub_worker.protocol.records import dataclass


@dataclass(frozen=True)
class Scratch:
    """Absolute paths of one jail's writable folders.

    Attributes:
        work: The working directory: shows the snapshot's files and takes new ones.
        shared_memory: The folder for files of ``shm_open``, or None.
    """

    home: str
    temporary: str
    work: str
    shared_memory: str | None = None

    @classmethod
    def in_namespace(cls) -> Scratch:
        """Returns the folders of a jail with its own mount namespace."""
        return cls(HOME, TEMPORARY, WORK, SHARED_MEMORY)

    @classmethod
    def on_host(cls, folder: str, shared_memory: str | None = None) -> Scratch:
        """Returns the folders that ``create`` makes in ``folder``."""
        return cls(f"{folder}/home", f"{folder}/tmp", f"{folder}/work", shared_memory)

    def create(self, snapshot: str, owner: int | None) -> None:
        """Make the folders, readable by their owner alone, and link the snapshot into ``work``.
        ``owner``: the user and group to give the folders to, or None to keep them.
        """
        parent = os.path.dirname(self.home)
        runtime = f"{self.temporary}/runtime"
        for folder in (parent, self.home, self.temporary, runtime, self.work):
            os.mkdir(folder, 0o700)
            if owner is not None:
                os.chown(folder, owner, owner)
        for name in os.listdir(snapshot):
            os.symlink(f"{snapshot}/{name}", f"{self.work}/{name}")


def remove_tree(path: str) -> None:
    """Remove a folder that a stranger filled; nothing may be running in it any more.

    Deep trees cost neither stack nor descriptors: a folder's sub-folders are moved up to the
    root before they are looked into. Symbolic links are removed, never followed.
    """
    try:
        root = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except FileNotFoundError:
        return
    try:
        _empty(root)
    finally:
        os.close(root)
    os.rmdir(path)


def _empty(root: int) -> None:
    # A random name: the stranger could not have made a file of that name.
    prefix, moved = f".{secrets.token_hex(8)}", 0
    # The stranger may have taken our own rights away.
    os.fchmod(root, 0o700)
    pending = _unlink_files(root)
    while pending:
        name = pending.pop()
        os.chmod(name, 0o700, dir_fd=root)
        folder = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=root)
        for child in _unlink_files(folder):
            # Renaming a folder into another one rewrites its "..", so it must be writable.
            os.chmod(child, 0o700, dir_fd=folder)
            moved += 1
            os.rename(child, f"{prefix}-{moved}", src_dir_fd=folder, dst_dir_fd=root)
            pending.append(f"{prefix}-{moved}")
        os.close(folder)
        os.rmdir(name, dir_fd=root)


def _unlink_files(folder: int) -> list[str]:
    """Remove all but the folders in ``folder`` and return those."""
    folders = []
    for name in os.listdir(folder):
        if stat.S_ISDIR(os.lstat(name, dir_fd=folder).st_mode):
            folders.append(name)
        else:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(name, dir_fd=folder)
    return folders
