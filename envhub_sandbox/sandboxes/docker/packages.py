"""A repository's packages for a container: made here, for the image's Python, and mounted there.

The folder is the one that a jail of this machine would be shown. So an interpreter of this machine
has to be of the kind of the image's, and no wheel may need a newer glibc than the image has.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from envhub_sandbox.dependencies.choice import Choice
from envhub_sandbox.dependencies.files import may_declare
from envhub_sandbox.errors import (
    DependencyError,
    InterpreterUnavailableError,
    SandboxUnavailableError,
    name_source,
)
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.option_names import option_name
from envhub_sandbox.sandboxes.docker.engines import Engine, EngineError, own_limits
from envhub_sandbox.sandboxes.docker.image import INTERPRETER

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.declared import Declared
    from envhub_sandbox.dependencies.host import Described
    from envhub_sandbox.dependencies.interpreters import Interpreter

# without site, so that nothing of what is installed there runs: its metadata is read
_ASK = """
import glob, json, os, platform, sys
from importlib import metadata
home = "/opt/environment" if os.path.exists("/opt/environment/bin/python") else "/opt/envhub-worker"
found = metadata.distributions(path=glob.glob(home + "/lib/python3*/site-packages"))
there = {one.metadata["Name"]: [one.version, one.requires or []] for one in found}
facts = [sys.implementation.name, platform.python_version(), os.uname().machine]
print(json.dumps([*facts, platform.libc_ver()[1], there]))
"""


@dataclass(frozen=True)
class Mounted:
    """An environment of this machine, for a container.

    Attributes:
        packages: Its folder.
        facts: What is in it.
        python: Nothing: the interpreter is the image's.
    """

    packages: str
    facts: dict[str, Any]
    python: str = ""


def provided(snapshot: Snapshot, choice: Choice, engine: Engine, image: str) -> Mounted | None:
    """The packages of a repository, for an image; None where the image has them.

    Args:
        snapshot: The verified files.
        choice: What the caller says.
        engine: Who has the image.
        image: Its id.

    Raises:
        DependencyError: They cannot be made, or not for that image.
        SandboxUnavailableError: It is no image of ours.
    """
    if choice.where == "host" or (
        choice.where == "auto" and not may_declare(snapshot.root, snapshot.path)
    ):
        return None
    try:
        return _provided(snapshot, choice, engine, image)
    except DependencyError as error:
        name_source(error, snapshot.label)
        raise


def _provided(snapshot: Snapshot, choice: Choice, engine: Engine, image: str) -> Mounted | None:
    from envhub_sandbox.dependencies import host, progress
    from envhub_sandbox.dependencies.declared import declared
    from envhub_sandbox.dependencies.prepare import Needs, prepare

    found = declared(snapshot.root, snapshot.path)
    if choice.where == "auto" and found is None:
        return None
    interpreter, there = inside(engine, image)
    has_all = found is not None and host.lacks(found, there, interpreter.version) is None
    if choice.where == "auto" and has_all:
        return None
    ours = fitting(interpreter, choice, found)
    with progress.shown("packages") as tell:
        made = prepare(Needs(found, replace(choice, where="own", python=ours.path)), tell)
    return Mounted(str(made.packages), made.facts)


@lru_cache(maxsize=16)
def inside(engine: Engine, image: str) -> tuple[Interpreter, dict[str, Described]]:
    """The interpreter of an image, and what is installed for its jails; by the image's id.

    Raises:
        SandboxUnavailableError: It is none of ours.
    """
    from envhub_sandbox.dependencies.host import Described
    from envhub_sandbox.dependencies.interpreters import Interpreter, release

    try:
        said = engine.run(
            *("run", "--rm", "--no-healthcheck", "--network", "none", "--read-only"),
            *("--cap-drop", "ALL", "--security-opt", "no-new-privileges", "--pull", "never"),
            *(word for limit in own_limits(engine) for word in ("--ulimit", limit)),
            *("--entrypoint", INTERPRETER, image, "-I", "-S", "-c", _ASK),
        )
        implementation, version, machine, libc, there = json.loads(said)
        installed = {
            str(name): Described(str(version), tuple(map(str, requires)))
            for name, (version, requires) in there.items()
        }
    except (EngineError, ValueError, TypeError, AttributeError) as error:
        raise SandboxUnavailableError(f"{image!r} is no image of envhub-worker: {error}") from error
    facts = (str(implementation), release(str(version)), str(machine), str(libc))
    return Interpreter(INTERPRETER, *facts), installed


def fitting(theirs: Interpreter, choice: Choice, found: Declared | None) -> Interpreter:
    """An interpreter of this machine whose packages the image's can import.

    Raises:
        InterpreterUnavailableError: There is none.
    """
    from packaging.specifiers import SpecifierSet
    from packaging.version import Version

    from envhub_sandbox.dependencies import interpreters

    asked = SpecifierSet(found.python if found else "")
    if not theirs.fits(asked) or (choice.python and not _is_asked(theirs, choice.python)):
        wanted = choice.python or str(asked)
        raise InterpreterUnavailableError(
            f"it is to run in Python {wanted}, and the image has {theirs.version}: build "
            "envhub-worker from another base (docs/deployment.md)"
        )
    minor = ".".join(theirs.version.split(".")[:2])
    try:
        ours = interpreters.find(minor)
    except InterpreterUnavailableError as error:
        raise InterpreterUnavailableError(
            f"packages for the image's Python {minor} are made with one of this machine, which has "
            f"none. {_remedy()}"
        ) from error
    alike = (ours.implementation, ours.machine) == (theirs.implementation, theirs.machine)
    if not alike or not ours.libc or not theirs.libc or Version(ours.libc) > Version(theirs.libc):
        raise InterpreterUnavailableError(
            f"packages of this machine ({ours.machine}, glibc {ours.libc or 'unknown'}) cannot be "
            f"used in the image ({theirs.machine}, glibc {theirs.libc or 'unknown'}). {_remedy()}"
        )
    return ours


def _is_asked(theirs: Interpreter, asked: str) -> bool:
    from envhub_sandbox.dependencies import interpreters

    return "/" not in asked and theirs.fits(interpreters.versions(asked))


def _remedy() -> str:
    return (
        "Build an image with its packages (envhub image build REF, then "
        f"{option_name('sandbox', 'docker:IMAGE')}), or take those of the image as they are with "
        f"{option_name('dependencies', 'host')}"
    )
