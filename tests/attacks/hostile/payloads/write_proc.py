"""Open for writing what /proc has of the kernel and of other processes, and name an own thread."""

import contextlib
import os
import stat
import threading


def attack():
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
    return {"others": found, "named": named(), "score": score()}


def _itself():
    return {str(os.getpid()), "self", "thread-self"}


def named():
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


def score():
    """The lowest that this process gets for its chance to be ended when memory is short."""
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
        file.write("0")
    with open("/proc/self/oom_score_adj") as file:
        return int(file.read())
