"""A runner from its fork to the call of its target: confinement, packages, start.

Everything here runs before the repository's code. The order matters: each step that needs a
privilege comes before that privilege is dropped, and the system call filter comes last.

A repository's own packages are added after the filter. Their folder holds a stranger's code, much
of which runs unasked: lines of ``.pth`` files, plugins that another package imports, any module
named ``numpy``. So the zygote of such jails runs without ``site``, never has the folder on its
path, and imports the standard library only.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import random
import runpy
import site
import socket
import sys
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import asdict
from typing import NoReturn

from envhub_worker.find_extra import find_extra
from envhub_worker.lockdown.context import JailContext
from envhub_worker.lockdown.layers import Layer, LayerUnavailableError
from envhub_worker.lockdown.mechanisms import process, reap
from envhub_worker.lockdown.mechanisms.environment import jail_environment
from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.lockdown.stages import runner
from envhub_worker.spawn import blas
from envhub_worker.spawn.channel import Channel

# Loaded before this process is confined, when it can still read its own files.
display, lerobot_stub = find_extra("display"), find_extra("lerobot_stub")

_GRANTED = ("HF_HOME", "HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE")
"""Variables by which a caller gives another cache to the jail."""
_SELF_TEST = Layer("self-test", True, "the denials above were tried and held")


def run(jail: JailContext, fds: list[int], status: int, runners: int) -> NoReturn:
    """Confine this freshly forked process, report, and run the target. Never returns.

    Args:
        fds: The stream to the server, then further descriptors from the server.
        status: Socket for the report to init; closed before the target runs.
        runners: The jail's number of runners, this one included.
    """
    code = 1
    try:
        code = _run(jail, fds, Channel(socket.socket(fileno=status)), runners)
    except SystemExit as error:
        code = _exit_code(error)
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except BaseException:
                continue  # the stranger may have replaced or closed it
        # Not sys.exit, which would run the zygote's atexit handlers and unwind init's frames.
        os._exit(code & 0xFF)


def _run(jail: JailContext, fds: list[int], init: Channel, runners: int) -> int:
    try:
        confine(jail, fds, init)
    except LayerUnavailableError as error:
        init.send(error.to_wire())
        return 1
    # In this order. Threads come after the confinement, which binds only the thread that asks for
    # it and what that starts later. Then the report: the server takes the runner for confined from
    # here on. The channel to init is closed before anything is read that a stranger wrote.
    blas.restore_threads(jail.common.set_blas_threads, runners)
    init.send({"report": [asdict(_SELF_TEST)]})
    init.close()
    make_hub_cache(jail.spec)
    if lerobot_stub is not None:
        lerobot_stub.install()
    if display is not None:
        display.start(jail.spec)
    main = _main(jail, runners)  # not before init is out of reach: packages may be a stranger's
    stream = socket.socket(fileno=fds[0])
    return int(main(stream, jail.spec, fds[1:]) or 0)


def make_hub_cache(spec: JailSpec) -> None:
    """Lay out a cache of the Hub in the jail's home. All runners of a jail make the same cache.

    It has huggingface_hub's layout: for each repository a folder with ``refs/main``, which names
    the commit, and ``snapshots/COMMIT``, which is a link to the files. ``HF_HUB_OFFLINE`` (see
    ``lockdown.mechanisms.environment``) makes ``snapshot_download`` and ``hf_hub_download`` look
    there and nowhere else.
    """
    if any(name in spec.confinement.environment for name in _GRANTED):
        return
    for copy in spec.hub_copies:
        folder = f"{os.environ['HF_HOME']}/hub/{copy.folder}"
        for revision in copy.revisions:
            _write(f"{folder}/refs/{revision}", copy.commit)
        os.makedirs(f"{folder}/snapshots", exist_ok=True)
        with contextlib.suppress(FileExistsError):
            os.symlink(copy.tree or spec.snapshot, f"{folder}/snapshots/{copy.commit}")


def _write(path: str, text: str) -> None:
    """Write a whole file at once: the runners of a jail share their home and do this together."""
    os.makedirs(os.path.dirname(path), exist_ok=True)
    draft = f"{path}.{os.getpid()}.draft"
    with open(draft, "w") as file:
        file.write(text)
    os.replace(draft, path)


def _main(
    jail: JailContext, runners: int
) -> Callable[[socket.socket, JailSpec, list[int]], int | None]:
    """Import the runner's main function, after adding the repository's own packages, if any."""
    config = jail.common.config
    if not config.packages:
        return _resolve(config.target)
    _bring_in(config.packages, jail.scratch.home)
    try:
        with blas.threads_at_load(runners):
            return _resolve(config.target)
    except ModuleNotFoundError as error:
        raise SystemExit(
            f"ModuleNotFoundError: {error}, in {config.packages}. Every jail imports cloudpickle, "
            "gymnasium, msgpack and numpy from it: make the environment again with these"
        ) from None


def _resolve(target: str) -> Callable[[socket.socket, JailSpec, list[int]], int | None]:
    module, _, function = target.partition(":")
    if module.endswith(".py"):
        return runpy.run_path(module)[function]  # type: ignore[no-any-return]
    return getattr(importlib.import_module(module), function)  # type: ignore[no-any-return]


def confine(jail: JailContext, fds: list[int], init: Channel) -> None:
    """Give up every right that the jail does not need."""
    # In this order: the end of init is our end from the first line on. A process group of our own
    # is what init ends orphans by. The control group is joined before anything is allocated that it
    # should count, and while its descriptors are open: the next line but one closes them. The
    # environment is built while the zygote's can still be read. ``runner.enter`` is last; it has
    # an order of its own, and after it there is nothing left to give up.
    process.die_with_parent(jail.init)
    os.setpgid(0, 0)
    for group in jail.joins:
        os.write(group, b"0")  # this process, which has one thread
    process.reset_signals(reap.HANDLED)
    descriptors = {0, 1, 2, init.fileno(), *fds}
    process.close_all_but({*descriptors, *jail.view.shared.values()})
    _forget_the_zygote(jail)
    if display is not None:  # without it, init has refused a policy that asks for one
        display.check(jail.spec, os.environ)
    runner.enter(jail, descriptors, lambda listener: init.send({"broker": True}, [listener]))


def _forget_the_zygote(jail: JailContext) -> None:
    """Set our own environment, folders and random numbers: all forks inherit the zygote's."""
    scratch, granted = jail.scratch, jail.spec.confinement.environment
    network = jail.spec.confinement.network
    built = jail_environment(os.environ, granted, scratch.home, scratch.temporary, network)
    os.environ.clear()
    os.environ.update(built)
    sys.argv = [jail.spec.entry]  # a repository may parse it; ours are not its arguments
    os.chdir(scratch.work)
    os.umask(0o022)
    # The zygote may have cached what follows, and forks share their generators' state.
    tempfile.tempdir = None
    random.seed()
    numpy = sys.modules.get("numpy")
    if numpy is not None:  # one number: an array, as it takes itself, costs a tenth of the spawn
        numpy.random.seed(int.from_bytes(os.urandom(4), "little"))


def _exit_code(error: SystemExit) -> int:
    if error.code is None or isinstance(error.code, int):
        return error.code or 0
    sys.stderr.write(f"{error.code}\n")
    return 1


def _bring_in(folder: str, home: str) -> None:
    """Turn this confined process into an interpreter with the packages in ``folder``.

    They come after the standard library on the path, with their ``.pth`` files and the names that
    ``site`` adds to builtins. Programs started as ``sys.executable`` have them, too.
    ``home``: the jail's own home, where each of its runners makes the same environment.
    """
    environment = f"{home}/.environment"
    _make_environment(environment, folder)
    sys.executable = f"{environment}/bin/python"
    sys.prefix = sys.exec_prefix = environment
    site.PREFIXES[:] = [environment]  # packages look there for their own files
    site.ENABLE_USER_SITE = False
    site.getusersitepackages()  # sets it, as at each start of Python
    os.environ["PATH"] = f"{environment}/bin:{folder}/bin:{os.environ['PATH']}"
    os.environ["VIRTUAL_ENV"] = environment
    site.setquit()
    site.setcopyright()
    site.sethelper()
    site.addsitedir(folder)


def _make_environment(environment: str, folder: str) -> None:
    """Make a virtual environment, like ``venv``, with packages from another folder."""
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
    home = os.path.dirname(base)
    _write(f"{environment}/pyvenv.cfg", f"home = {home}\ninclude-system-site-packages = false\n")
