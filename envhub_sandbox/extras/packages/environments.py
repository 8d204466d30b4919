"""Makes folders of packages, one per lock and interpreter: made once, read-only, shared by hash.

::

    <cache>/environments/<key>/
            environment.json    its description; the file's time is that of the last use
        lock.txt            the pins, as uv installed them
        packages/           what uv installed, 0444 in folders 0555, with its bytecode
    <cache>/environments/<key>.lock

The holder of the lock makes a folder under another name and renames it into place: a folder with a
key as its name is complete. Nothing in it ever runs here. No interpreter has it as an environment,
so none reads its ``.pth`` or ``sitecustomize`` at the start; a jail adds the folder to its path
only after it is confined.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import stat
import subprocess
import time
from dataclasses import asdict, dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

import envhub_worker.protocol
from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages.bounds import Bounds, Watch, checked, walk
from envhub_sandbox.extras.packages.interpreters import Interpreter
from envhub_sandbox.extras.packages.request import Tell
from envhub_sandbox.extras.packages.resolution import index, uv
from envhub_sandbox.extras.packages.resolution.pylock import Lock
from envhub_sandbox.system import folders, locks
from envhub_sandbox.system.folders import BUILDING, CACHE_VARIABLE, cache_root, draft, remove_tree
from envhub_sandbox.system.locks import sharers
from envhub_sandbox.system.platform import own_variables
from envhub_worker.protocol.runtime import RECORD

_FORMAT = 1
_INSTALL_S = 3600.0
_WAIT_S = 2 * 3600.0
_COMPILE_S = 1800.0
_COMPILERS = 8
_FULL = "'envhub cache remove --unused-for 30' removes what was not used for 30 days"
_THERE = (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR)

_BOOTSTRAP = Path(envhub_worker.protocol.__file__).parent.parent / "bootstrap.py"


@dataclass(frozen=True)
class Environment:
    """A complete environment, for an interpreter by its absolute path.

    Attributes:
        key: The hash of the lock and the interpreter.
        lock: SHA-256 of the lock's text.
        pins: ``name==version`` of each package.
        used: Unix time (seconds) of the last use.
    """

    key: str
    python: str
    version: str
    lock: str
    pins: tuple[str, ...]
    size: int
    used: float = field(compare=False)
    home: Path

    @property
    def packages(self) -> Path:
        """Returns the folder that an interpreter adds to its path."""
        return self.home / "packages"

    def answers_to(self, name: str) -> bool:
        """Tells whether a name means this environment: at least seven characters of its key."""
        return len(name) >= 7 and self.key.startswith(name)

    @property
    def facts(self) -> dict[str, Any]:
        """Returns its content as plain data."""
        return {"lock": f"sha256:{self.lock}", "packages": list(self.pins)}


def root() -> Path:
    """Returns the folder of all environments."""
    return cache_root() / "environments"


def key_of(lock: Lock, interpreter: Interpreter) -> str:
    """Returns the name of the environment for a lock and an interpreter."""
    facts = json.dumps([_FORMAT, lock.text, asdict(interpreter)])
    return hashlib.sha256(facts.encode()).hexdigest()[:40]


def ready(key: str) -> Environment | None:
    """Returns the environment of this name if it is complete. Raises ``DependencyError``."""
    environment = _read(root() / key)
    if environment is not None:
        _refuse_shared(environment.home)
    return environment


def provide(lock: Lock, interpreter: Interpreter, tell: Tell = lambda line: None) -> Environment:
    """Returns the environment for a lock and an interpreter; makes it if needed; marks it as used.

    A second process that requests the same environment waits for the first.
    Raises ``DependencyError``.
    """
    key = key_of(lock, interpreter)
    environment = ready(key)
    if environment is None:
        held = root() / f"{key}.lock"
        waiting = "waiting for another process, which makes the same environment"
        try:
            folders.make(root())
            _refuse_shared(root())
            with locks.held(held, wait_s=_WAIT_S, on_wait=lambda: tell(waiting)) as descriptor:
                environment = ready(key) or _made(key, lock, interpreter, descriptor, tell)
        except TimeoutError as error:
            raise DependencyError(
                f"another process has been making the same environment for {_WAIT_S / 3600:.0f} "
                f"hours, and holds the lock {held}. End it, and try again"
            ) from error
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            advice = _FULL if full else "Fix its permissions"
            raise DependencyError(
                f"the environments in {root()} cannot be written: {error}. {advice}, or set "
                f"{CACHE_VARIABLE} to another folder"
            ) from error
    with contextlib.suppress(OSError):
        os.utime(environment.home / RECORD)
    return environment


def every() -> list[Environment]:
    """Returns all environments, the latest used first."""
    environments = [_read(record.parent) for record in root().glob(f"[!.]*/{RECORD}")]
    return sorted(
        (environment for environment in environments if environment is not None),
        key=attrgetter("used"),
        reverse=True,
    )


def remove(environment: Environment) -> str:
    """Removes an unused environment. Returns who makes or uses it, or "" if it is removed.

    Each process that starts jails with it, or could, shares the lock of its record.
    """
    lock, record = root() / f"{environment.key}.lock", environment.home / RECORD
    gone = root() / f"{BUILDING}{environment.key}-gone"
    try:
        with locks.held(lock), locks.held(record):
            # rename first: a folder with a key as its name is complete
            os.rename(environment.home, gone)
            remove_tree(gone)
            lock.unlink()
    except TimeoutError:
        users = {**sharers(record), **sharers(lock)}
        who = ", ".join(f"process {pid} ({command})" for pid, command in users.items())
        return (
            f"the environment {environment.key[:12]} is in use by "
            f"{who or 'a process that is not seen from here'}. Close its environments in that "
            "process, or end the process"
        )
    except OSError:
        return ""  # another process has removed it
    return ""


def half_made() -> list[Path]:
    """Returns folders in the making, and those whose maker was killed."""
    return sorted(root().glob(f"{BUILDING}*"))


def remove_abandoned() -> None:
    """Remove half-made folders of killed processes."""
    for path in half_made():
        key = path.name.removeprefix(BUILDING).partition("-")[0]
        lock = root() / f"{key}.lock"
        with contextlib.suppress(OSError), locks.held(lock):
            remove_tree(path)
            lock.unlink()


def _read(home: Path) -> Environment | None:
    try:
        record = home / RECORD
        facts = json.loads(record.read_bytes())
        if facts.pop("format") != _FORMAT or not (home / "packages").is_dir():
            return None
        pins = tuple(map(str, facts.pop("pins")))
        used = record.stat().st_mtime
        return Environment(key=home.name, home=home, pins=pins, used=used, **facts)
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _made(key: str, lock: Lock, interpreter: Interpreter, held: int, tell: Tell) -> Environment:
    for path in root().glob(f"{BUILDING}{key}-*"):
        remove_tree(path)  # its maker was killed, since we hold its lock
    with draft(root(), f"{BUILDING}{key}-") as building:
        packages = building / "packages"
        watch = Watch(Bounds.set(), building, [index.uv_cache()])
        with uv.cleared_after_refusal(lock.packages):
            _install(lock, interpreter, building, held, watch, tell)
            size, count = checked(packages)
            watch.bounds.check(size, count, "its packages have")
        tell(f"compiling its {size / 2**20:.0f} MiB to bytecode, once")
        _compile(interpreter, packages, held)
        checked(packages)  # again: a faulty compiler may leave a link, which chmod follows
        _close(packages)
        facts = {
            "format": _FORMAT,
            "python": interpreter.path,
            "version": interpreter.version,
            "lock": lock.digest,
            "pins": lock.packages,
            "size": size,
        }
        _publish(building, key, facts)
    environment = _read(root() / key)
    assert environment is not None
    return environment


def _publish(building: Path, key: str, facts: dict[str, object]) -> None:
    (building / RECORD).write_text(json.dumps(facts, indent=1))
    (building / RECORD).chmod(0o600)  # only its users may lock it
    building.chmod(folders.SHARED_MODE)
    try:
        os.rename(building, root() / key)
    except OSError as error:
        if error.errno not in _THERE:
            raise
        # the existing folder is damaged, by a power loss or by hand: move it away
        with draft(root(), f"{BUILDING}{key}-") as damaged:
            os.rename(root() / key, damaged / "damaged")
            os.rename(building, root() / key)


def _install(
    lock: Lock, interpreter: Interpreter, building: Path, held: int, watch: Watch, tell: Tell
) -> None:
    pins = building / "lock.txt"
    pins.write_text(lock.text)
    packages = building / "packages"
    packages.mkdir()
    watch.look()

    def hear(line: str) -> None:
        watch.hear(line)
        tell(line)

    # uv inherits our lock and holds it until it ends: if we are killed, no process removes files
    # that uv still writes. Copies, since others may change a file shared with uv's cache.
    uv.run(
        [
            *("pip", "install", *uv.NO_BUILDS, "--require-hashes", "--no-deps"),
            *("--link-mode", "copy", "--python", interpreter.path, "--target", str(packages)),
            *(*index.options(), *lock.options, "-r", str(pins)),
        ],
        what="the packages could not be installed",
        timeout_s=_INSTALL_S,
        tell=hear,
        keep=[held],
        watch=watch.look,
        file_bytes=watch.bounds.bytes,
    )
    (packages / ".lock").unlink(missing_ok=True)  # uv's own


def _compile(interpreter: Interpreter, packages: Path, held: int) -> None:
    """Compile bytecode for all packages, in processes confined to the folder (``bytecode.py``).

    A failure only makes imports slower, so it is no error.
    """
    count = min(_COMPILERS, os.cpu_count() or 1)
    command = [interpreter.path, "-I", "-S", str(_BOOTSTRAP), "bytecode", str(packages)]
    until = time.monotonic() + _COMPILE_S
    with contextlib.ExitStack() as stack:
        running = []
        for number in range(count):
            process = subprocess.Popen(
                [*command, str(number), str(count)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd="/",
                env=own_variables(),
                pass_fds=(held,),
            )
            running.append(stack.enter_context(process))
            stack.callback(process.kill)
        for process in running:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(until - time.monotonic(), 0))


def _close(packages: Path) -> None:
    """Make a folder readable for all users and writable for none."""
    for path in [*walk(packages), packages]:
        mode = path.lstat().st_mode
        runs = stat.S_ISDIR(mode) or mode & stat.S_IXUSR
        path.chmod(0o555 if runs else 0o444)


def _refuse_shared(place: Path) -> None:
    if why := folders.why_distrusted(place, cache_root()):
        raise DependencyError(
            f"the environments in {root()} are not trusted, because other users can change them: "
            f"{why}; or set {CACHE_VARIABLE} to a folder of your own"
        )
