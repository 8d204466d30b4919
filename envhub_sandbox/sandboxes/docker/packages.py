"""A repository's packages for a container: made here, for the image's Python, and mounted there.

The folder is the one that a jail of this machine would be shown. So an interpreter of this machine
has to be of the kind of the image's, and no wheel may need a newer glibc than the image has.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

from envhub_sandbox.dependencies.packages import HERE, PackageSet
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.errors import InterpreterUnavailableError, SandboxUnavailableError
from envhub_sandbox.sandboxes.docker.engines import (
    Engine,
    EngineError,
    find_image,
    own_limits,
)
from envhub_sandbox.settings.options import option_name

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.installed import InstalledPackage
    from envhub_sandbox.dependencies.interpreters import Interpreter

_INTERPRETER = "/opt/envhub-worker/bin/python"
"""The server's, in every image."""
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


class ImageTarget:
    """The Python of an image. ``engine``: gives the engine, once there is something to ask it."""

    def __init__(self, engine: Callable[[], Engine], image: str) -> None:
        self._engine = engine
        self._image = image

    def _inside(self) -> tuple[Interpreter, dict[str, InstalledPackage]]:
        engine = self._engine()
        return image_packages(engine, find_image(engine, self._image))

    def meets(self, request: PackageRequest) -> bool:
        """Whether the image has all of it; raises as ``image_packages``."""
        from packaging.utils import canonicalize_name

        from envhub_sandbox.dependencies import installed

        interpreter, there = self._inside()
        names = set(map(canonicalize_name, there))
        known = all(one.is_among(names) for one in request.guesses)
        return known and installed.first_unmet(request, there, interpreter.version) is None

    def make(self, request: PackageRequest, tell: Callable[[str], None]) -> PackageSet:
        """An environment of this machine, to be mounted; its interpreter is the image's.
        Raises ``DependencyError``: it cannot be made, or not for that image;
        ``SandboxUnavailableError``: it is no image of ours.
        """
        ours = interpreter_fitting(self._inside()[0], request)
        made = HERE.make(replace(request, python=ours.path), tell)
        return replace(made, python="")


@lru_cache(maxsize=16)
def image_packages(engine: Engine, image: str) -> tuple[Interpreter, dict[str, InstalledPackage]]:
    """The interpreter of an image, and what is installed for its jails; by the image's id.
    Raises ``SandboxUnavailableError``: it is none of ours.
    """
    from envhub_sandbox.dependencies.installed import InstalledPackage
    from envhub_sandbox.dependencies.interpreters import Interpreter, release

    try:
        said = engine.run(
            *("run", "--rm", "--no-healthcheck", "--network", "none", "--read-only"),
            *("--cap-drop", "ALL", "--security-opt", "no-new-privileges", "--pull", "never"),
            *(word for limit in own_limits(engine) for word in ("--ulimit", limit)),
            *("--entrypoint", _INTERPRETER, image, "-I", "-S", "-c", _ASK),
        )
        implementation, version, machine, libc, there = json.loads(said)
        installed = {
            str(name): InstalledPackage(str(version), tuple(map(str, requires)))
            for name, (version, requires) in there.items()
        }
    except (EngineError, ValueError, TypeError, AttributeError) as error:
        raise SandboxUnavailableError(
            f"{image!r} is not an image of envhub-worker: {error}"
        ) from error
    facts = (str(implementation), release(str(version)), str(machine), str(libc))
    return Interpreter(_INTERPRETER, *facts), installed


def interpreter_fitting(theirs: Interpreter, request: PackageRequest) -> Interpreter:
    """An interpreter of this machine whose packages the image's can import.
    Raises ``InterpreterUnavailableError``: there is none.
    """
    from packaging.specifiers import SpecifierSet
    from packaging.version import Version

    from envhub_sandbox.dependencies import interpreters

    asked = SpecifierSet(request.supports)
    if not theirs.fits(asked) or (request.python and not _is_asked(theirs, request.python)):
        wanted = request.python or str(asked)
        raise InterpreterUnavailableError(
            f"it needs Python {wanted}, and the image has {theirs.version}: build envhub-worker "
            "from another base (docs/deployment.md)"
        )
    minor = ".".join(theirs.version.split(".")[:2])
    try:
        ours = interpreters.find(minor)
    except InterpreterUnavailableError as error:
        raise InterpreterUnavailableError(
            f"packages for the image's Python {minor} need the same Python on this machine, which "
            f"does not have it. {_remedy()}"
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
        f"{option_name('sandbox', 'docker:IMAGE')}), or use the image's packages with "
        f"{option_name('dependencies', 'host')}"
    )
