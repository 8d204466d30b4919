"""Packages of a repository's own, brought into a runner: after its confinement, and not before.

Such a folder holds a stranger's code, and much of it would run by itself: the lines of ``.pth``
files, plugins that another package imports, and whatever it calls ``numpy``. So the zygote of such
jails runs without ``site``, never has the folder on its path, and imports the standard library
only. A runner adds the folder when nothing is left that it could do.
"""

from __future__ import annotations

import contextlib
import os
import site
import sys

# Of the standard library, what numpy and Gymnasium import: the zygote may, it is the interpreter's.
STANDARD = (
    "contextvars",
    "csv",
    "ctypes",
    "datetime",
    "difflib",
    "heapq",
    "importlib.metadata",
    "importlib.resources",
    "ipaddress",
    "locale",
    "logging",
    "mmap",
    "multiprocessing.connection",
    "multiprocessing.context",
    "multiprocessing.sharedctypes",
    "numbers",
    "pathlib",
    "pickle",
    "platform",
    "string",
    "tempfile",
    "threading",
    "typing",
    "urllib.parse",
    "uuid",
    "zipfile",
)


def bring_in(folder: str, home: str) -> None:
    """Make this confined process one of an environment whose packages are ``folder``.

    Behind the standard library, as the packages of any interpreter, with their ``.pth`` files; and
    what of ``site`` a program may expect. What it starts as ``sys.executable`` has them as well.

    Args:
        home: The jail's own home. All of its runners make the same there.
    """
    environment = f"{home}/.environment"
    _make_environment(environment, folder)
    sys.executable = f"{environment}/bin/python"
    sys.prefix = sys.exec_prefix = environment
    os.environ["PATH"] = f"{environment}/bin:{folder}/bin:{os.environ['PATH']}"
    os.environ["VIRTUAL_ENV"] = environment
    site.setquit()
    site.setcopyright()
    site.sethelper()
    site.addsitedir(folder)


def _make_environment(environment: str, folder: str) -> None:
    """A virtual environment, as ``venv`` makes it, around packages that lie elsewhere."""
    major, minor = sys.version_info[:2]
    library = f"{environment}/lib/python{major}.{minor}"
    binaries = f"{environment}/bin"
    for path in (library, binaries):
        os.makedirs(path, exist_ok=True)
    base = os.path.realpath(sys.executable)
    links = {f"{library}/site-packages": folder}
    links |= {
        f"{binaries}/{name}": base for name in ("python", "python3", f"python{major}.{minor}")
    }
    for path, target in links.items():
        with contextlib.suppress(FileExistsError):
            os.symlink(target, path)
    draft = f"{environment}/{os.getpid()}.draft"
    with open(draft, "w") as file:
        file.write(f"home = {os.path.dirname(base)}\ninclude-system-site-packages = false\n")
    os.replace(draft, f"{environment}/pyvenv.cfg")
