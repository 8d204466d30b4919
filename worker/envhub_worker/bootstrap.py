"""Runs this package in any interpreter by its path, without an entry on ``sys.path``.

The interpreter may lack ``envhub_worker`` (in a repository's own environment), and a repository may
bring a ``worker.py`` of its own. So this file loads the package from its own folder::

    python -I .../bootstrap.py worker ARGS...    envhub_worker.__main__.main(ARGS)
    python -s .../bootstrap.py zygote ARGS...    envhub_worker.spawn.zygote.main(ARGS)
    python -I .../bootstrap.py probe             envhub_worker.lockdown.probe.main([])
    python -I -S .../bootstrap.py bytecode PATH  envhub_worker.extras.bytecode.main
"""

from __future__ import annotations

import sys

if __name__ == "__main__" and not (sys.flags.isolated or getattr(sys.flags, "safe_path", False)):
    del sys.path[0]  # the folder of this file, whose modules are nobody else's

import importlib
import importlib.util
import os
from collections.abc import Sequence

_PROGRAMS = {
    "worker": "envhub_worker.__main__",
    "zygote": "envhub_worker.spawn.zygote",
    "probe": "envhub_worker.lockdown.probe",
    "bytecode": "envhub_worker.extras.bytecode",
}

_NEEDED = {name: name for name in ("cloudpickle", "gymnasium", "msgpack", "numpy")}
_NEEDED |= {"zmq": "pyzmq"}
"""What this package imports, and what that is called where it is installed from."""


def command(
    python: str, program: str, *args: str, site: bool = True, options: Sequence[str] = ()
) -> list[str]:
    """Returns the argv that runs ``program`` (a key of ``_PROGRAMS``) with ``args`` in ``python``.

    Without ``site`` only the standard library can be imported, and no start-up file of a package
    runs: no ``.pth``, no ``sitecustomize``. A zygote obeys Python's environment variables, since we
    build its environment.
    """
    flags = ["-s" if program == "zygote" else "-I", *([] if site else ["-S"])]
    return [python, *flags, os.path.abspath(__file__), *options, program, *args]


def _add_user_site(folder: str) -> None:
    """Adds the packages of ``pip install --user``, before those of all users, like Python.

    Python itself finds them by ``HOME``, which a server and a zygote do not have.
    """
    import site

    site.USER_SITE = folder
    known = list(sys.path)
    site.addsitedir(folder)
    shared = [known.index(path) for path in site.getsitepackages() if path in known]
    first = min(shared, default=len(known))
    sys.path[:] = [*known[:first], *sys.path[len(known) :], *known[first:]]


def load_package() -> None:
    """Make ``import envhub_worker`` mean the folder of this file."""
    folder = os.path.dirname(os.path.abspath(__file__))
    spec = importlib.util.spec_from_file_location(
        "envhub_worker", os.path.join(folder, "__init__.py"), submodule_search_locations=[folder]
    )
    assert spec is not None
    assert spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules["envhub_worker"] = package
    spec.loader.exec_module(package)


def main(argv: Sequence[str]) -> int:
    """Load the package and run the program that ``argv`` names; return its exit code."""
    if argv[:1] == ["--user-site"]:
        _add_user_site(argv[1])
        argv = argv[2:]
    if not argv or argv[0] not in _PROGRAMS:
        sys.stderr.write(f"usage: bootstrap.py {{{','.join(_PROGRAMS)}}} ARGS...\n")
        return 2
    load_package()
    # Import now: later this process may be another user, who may not read the file.
    hidden = importlib.import_module("envhub_worker.file_access").why_file_hidden
    try:
        program = importlib.import_module(_PROGRAMS[argv[0]])
        return int(program.main(list(argv[1:])) or 0)
    except ModuleNotFoundError as error:
        why = hidden(error.name or "")
        if why:
            sys.stderr.write(f"PermissionError: {sys.executable}: {error}, but {why}\n")
            return 1
        if error.name not in _NEEDED:
            raise
        needed = " ".join(_NEEDED.values())
        sys.stderr.write(
            f"ModuleNotFoundError: {sys.executable} has no {_NEEDED[error.name]}, which the worker "
            f"needs; install all of it there: {sys.executable} -m pip install {needed}\n"
        )
        return int(importlib.import_module("envhub_worker.protocol.confinement").LACKS_PACKAGES)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
