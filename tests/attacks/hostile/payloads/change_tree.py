"""Change what is in folders, each in another way; the folder's name says which."""

import ctypes
import mmap
import os
import shutil

_AT_FDCWD, _EXCHANGE = -100, 2


def change_tree(place):
    errors = []
    for name, change in WAYS.items():
        try:
            change(os.path.join(place, name))
        except OSError as error:
            errors.append(f"{name}: {error}")
    return errors


def _create(folder):
    _write(f"{folder}/new", "w")


def _append(folder):
    os.chmod(f"{folder}/file", 0o666)
    _write(f"{folder}/file", "a")


def _write(path, mode):
    with open(path, mode) as file:
        file.write("attacked")


def _truncate(folder):
    os.chmod(f"{folder}/file", 0o666)
    os.truncate(f"{folder}/file", 1)


def _replace(folder):
    _write(f"{folder}/other", "w")
    os.replace(f"{folder}/other", f"{folder}/file")


def _remove(folder):
    os.unlink(f"{folder}/file")


def _move(folder):
    os.rename(f"{folder}/file", f"{folder}/moved")


def _exchange(folder):
    _write(f"{folder}/other", "w")
    paths = [f"{folder}/{name}".encode() for name in ("file", "other")]
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.renameat2(_AT_FDCWD, paths[0], _AT_FDCWD, paths[1], _EXCHANGE):
        raise OSError(ctypes.get_errno(), "renameat2")


def _link(folder):
    os.link(f"{folder}/file", f"{folder}/linked")
    _write(f"{folder}/linked", "a")


def _map(folder):
    os.chmod(f"{folder}/file", 0o666)
    with open(f"{folder}/file", "r+b") as file, mmap.mmap(file.fileno(), 0) as memory:
        memory[:3] = b"ATT"


def _descriptor(folder):
    descriptor = os.open(f"{folder}/file", os.O_RDONLY)  # of the shared file, before it is copied
    os.chmod(f"{folder}/file", 0o666)
    _write(f"/proc/self/fd/{descriptor}", "w")


def _set_user_id(folder):
    os.chmod(f"{folder}/file", 0o6755)


def _times(folder):
    os.utime(f"{folder}/file", (1, 1))


def _attribute(folder):
    os.setxattr(f"{folder}/file", "user.attack", b"1")


def _mark_opaque(folder):
    os.setxattr(folder, "user.overlay.opaque", b"y")


def _mark_whiteout(folder):
    os.setxattr(f"{folder}/file", "user.overlay.whiteout", b"")


def _empty(folder):
    shutil.rmtree(f"{folder}/deeper")
    os.mkdir(f"{folder}/deeper")


WAYS = {
    "append": _append,
    "create": _create,
    "exchange": _exchange,
    "hard link": _link,
    "map and write": _map,
    "mark a file as removed": _mark_whiteout,
    "mark a folder as opaque": _mark_opaque,
    "move": _move,
    "open again by its descriptor": _descriptor,
    "put an empty folder in place": _empty,
    "remove": _remove,
    "replace": _replace,
    "set an attribute": _attribute,
    "set its times": _times,
    "set its user id": _set_user_id,
    "truncate": _truncate,
}
