"""Open nodes of devices and of /proc."""

import contextlib
import mmap
import os
import stat
import tempfile
import threading

_KMSG = os.makedev(1, 11)


def kernel_log_device():
    """Make a device node and open it: here the kernel's log, with a disk it would be the same."""
    node = os.path.join(tempfile.mkdtemp(), "device")
    os.mknod(node, stat.S_IFCHR | 0o600, _KMSG)
    device = os.open(node, os.O_RDONLY | os.O_NONBLOCK)
    os.unlink(node)
    lines = []
    while True:
        try:
            lines.append(os.read(device, 8192).decode("utf-8", "replace"))
        except BlockingIOError:
            return lines[-100:]
        except BrokenPipeError:
            continue  # older lines were overwritten meanwhile


def open_nodes(nodes):
    """Open each of some device nodes: which could be opened, and why the others could not."""
    found = {}
    for path in nodes:
        try:
            os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK))
            found[path] = "opened"
        except OSError as error:
            found[path] = error.strerror
    return found


def reach_devices(nodes, folders):
    """Open each of some nodes, list each of some folders, and map shared zeros: what came of it."""
    return {"nodes": _nodes_read(nodes), "folders": _listed(folders), "zeros": _zeros()}


def _nodes_read(nodes):
    found = {}
    for path in nodes:
        with contextlib.suppress(OSError):
            fd = os.open(path, os.O_RDWR)
            found[path] = os.read(fd, 64).decode()
            os.close(fd)
    return found


def _listed(folders):
    found = {}
    for path in folders:
        with contextlib.suppress(OSError):
            found[path] = os.listdir(path)
    return found


def _zeros():
    """Shared memory that no limit on pieces bounds; then all but a page leaves every account."""
    with contextlib.suppress(OSError):
        fd = os.open("/dev/zero", os.O_RDWR)
        mmap.mmap(fd, 8 << 20).write(b"x" * (8 << 20))
        return "mapped"
    return ""


def write_proc():
    """Open for writing what /proc has of the kernel and of others, and name an own thread."""
    found = []
    for folder, names, files in os.walk("/proc"):
        own = folder == "/proc"
        names[:] = [name for name in names if not (own and name in _itself())]
        for name in files:
            path = os.path.join(folder, name)
            with contextlib.suppress(OSError):
                mode = os.stat(path).st_mode
                # /dev/null lies over some; of what everybody may open the kernel judges the write
                if stat.S_ISREG(mode) and not mode & stat.S_IWOTH:
                    os.close(os.open(path, os.O_WRONLY | os.O_NONBLOCK))
                    found.append(path)
    return {"others": found, "named": _named(), "score": _score()}


def _itself():
    return {str(os.getpid()), "self", "thread-self"}


def _named():
    """Whether another thread can be named, as CUDA does it."""
    done = threading.Event()
    thread = threading.Thread(target=done.wait)
    thread.start()
    try:
        with open(f"/proc/self/task/{thread.native_id}/comm", "w") as file:
            file.write("cuda")
        return True
    except OSError:
        return False
    finally:
        done.set()


def _score():
    """The lowest that this process gets for its chance to be ended when memory is short."""
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
        file.write("0")
    with open("/proc/self/oom_score_adj") as file:
        return int(file.read())
