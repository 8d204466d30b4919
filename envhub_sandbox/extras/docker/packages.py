"""A repository's packages for a container: in a folder that is mounted, or in a derived image.

The folder is made on this machine, as for a jail on it. So the image's interpreter must match an
interpreter of this machine, and the image's glibc may not be older than this machine's.

A derived image keeps the server's interpreter unchanged. The repository's packages are in
``/opt/environment``, where the worker looks for the interpreter of its jails, without the files
that every interpreter would run at its start.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

from envhub_sandbox.errors import DependencyError, SandboxUnavailableError
from envhub_sandbox.extras.docker.engines import (
    Engine,
    EngineError,
    environment,
    find_image,
    own_limits,
)
from envhub_sandbox.extras.packages.declared import versions
from envhub_sandbox.extras.packages.interpreters import (
    InstalledPackage,
    Interpreter,
    find,
    first_unmet,
    release,
)
from envhub_sandbox.extras.packages.packages import HERE, PackageSet
from envhub_sandbox.extras.packages.request import PackageRequest
from envhub_sandbox.extras.packages.resolution.pylock import Lock
from envhub_sandbox.extras.packages.resolution.resolutions import versions_for
from envhub_sandbox.extras.packages.resolution.resolve import Target, resolve
from envhub_sandbox.settings.options import option_name
from envhub_worker.protocol.text import printable

_INTERPRETER = "/opt/envhub-worker/bin/python"
"""The server's interpreter in every image."""
# Runs without site, so that no installed package runs: the program only reads their metadata.
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
    """Packages for the Python of an image. ``engine``: finds the engine when it is first needed."""

    def __init__(self, engine: Callable[[], Engine], image: str) -> None:
        self._engine = engine
        self._image = image

    def _inside(self) -> tuple[Interpreter, dict[str, InstalledPackage]]:
        return image_packages(self._engine(), self._image)

    def meets(self, request: PackageRequest) -> bool:
        """Whether the image has all requested packages; raises as ``image_packages``."""
        interpreter, installed = self._inside()
        names = set(map(canonicalize_name, installed))
        brings_all = all(guess.is_among(names) for guess in request.guesses)
        return brings_all and first_unmet(request, installed, interpreter.version) is None

    def make(self, request: PackageRequest, tell: Callable[[str], None]) -> PackageSet:
        """Make a folder of packages on this machine, to mount for the image's interpreter.
        Raises ``DependencyError``: it cannot be made, or the image cannot use it;
        ``SandboxUnavailableError``: this is not an image of envhub-worker.
        """
        ours = interpreter_fitting(self._inside()[0], request)
        packages = HERE.make(replace(request, python=ours.path), tell)
        return replace(packages, python="")


def image_packages(engine: Engine, image: str) -> tuple[Interpreter, dict[str, InstalledPackage]]:
    """Return an image's interpreter and the packages for its jails. ``image``: its id or name.
    Raises ``SandboxUnavailableError``: this is not an image of envhub-worker.
    """
    identity = find_image(engine, image)  # a name may mean another image later
    try:
        return _asked(engine, identity)
    except (EngineError, ValueError, TypeError, AttributeError) as error:
        raise SandboxUnavailableError(
            f"{image!r} is not an image of envhub-worker: {error}"
        ) from error


@lru_cache(maxsize=16)
def _asked(engine: Engine, image: str) -> tuple[Interpreter, dict[str, InstalledPackage]]:
    """Ask the image of an id; raises what a wrong answer raises."""
    answer = engine.run(
        *("run", "--rm", "--no-healthcheck", "--network", "none", "--read-only"),
        *("--cap-drop", "ALL", "--security-opt", "no-new-privileges", "--pull", "never"),
        *(word for limit in own_limits(engine) for word in ("--ulimit", limit)),
        *("--entrypoint", _INTERPRETER, image, "-I", "-S", "-c", _ASK),
    )
    implementation, version, machine, libc, there = json.loads(answer)
    installed = {
        str(name): InstalledPackage(str(version), tuple(map(str, requires)))
        for name, (version, requires) in there.items()
    }
    facts = (str(implementation), release(str(version)), str(machine), str(libc))
    return Interpreter(_INTERPRETER, *facts), installed


def interpreter_fitting(theirs: Interpreter, request: PackageRequest) -> Interpreter:
    """Find an interpreter of this machine whose packages the image's interpreter can import.
    Raises ``DependencyError``: there is none.
    """
    versions_asked = SpecifierSet(request.supports)
    asked = request.python
    is_asked = not asked or ("/" not in asked and theirs.fits(versions(asked)))
    if not (is_asked and theirs.fits(versions_asked)):
        wanted = asked or str(versions_asked)
        raise DependencyError(
            f"it needs Python {wanted}, and the image has {theirs.version}: build envhub-worker "
            "from another base (docs/deployment.md)",
            reason="interpreter",
        )
    minor = ".".join(theirs.version.split(".")[:2])
    try:
        ours = find(minor)
    except DependencyError as error:
        if error.reason != "interpreter":
            raise
        raise DependencyError(
            f"packages for the image's Python {minor} need the same Python on this machine, which "
            f"does not have it. {_remedy()}",
            reason="interpreter",
        ) from error
    alike = (ours.implementation, ours.machine) == (theirs.implementation, theirs.machine)
    if not alike or not ours.libc or not theirs.libc or Version(ours.libc) > Version(theirs.libc):
        raise DependencyError(
            f"packages of this machine ({ours.machine}, glibc {ours.libc or 'unknown'}) cannot be "
            f"used in the image ({theirs.machine}, glibc {theirs.libc or 'unknown'}). {_remedy()}",
            reason="interpreter",
        )
    return ours


def _remedy() -> str:
    return (
        "Build an image with its packages (envhub image build REF, then "
        f"{option_name('sandbox', 'docker:IMAGE')}), or use the image's packages with "
        f"{option_name('dependencies', 'host')}"
    )


LOCK_LABEL = "dev.envhub.lock"
_PACKAGE = re.compile(r"[a-z0-9][a-z0-9.+-]+")

# An interpreter runs these files at its start, before the worker confines it.
_STARTERS = "-name '*.pth' -o -name 'sitecustomize*' -o -name 'usercustomize*'"
_TEMPLATE = """\
FROM {base}
USER root
{system}RUN python3 -m venv /opt/environment
COPY requirements.lock /opt/environment/
RUN /opt/environment/bin/python -m pip install --no-cache-dir --no-deps --require-hashes \\
        --only-binary :all: -r /opt/environment/requirements.lock \\
    && find /opt/environment/lib -mindepth 3 -maxdepth 3 \\( {starters} \\) -exec rm -r {{}} + \\
    && chmod -R u=rwX,go=rX /opt/environment
LABEL {lock_label}={digest}
USER 65532:65532
"""


def target_of(engine: Engine, image: str) -> Target:
    """Return the Python version and the machine of an image; raises as ``image_packages``."""
    interpreter, _ = image_packages(engine, image)
    return Target(version=".".join(interpreter.version.split(".")[:2]), machine=interpreter.machine)


def tag_for(repository: str, base: str, lock: Lock, system: Sequence[str]) -> str:
    """Return the derived image's tag: the repository's name, and the hash of all inputs."""
    slug = re.sub(r"[^a-z0-9]+", "-", repository.lower()).strip("-")[-60:] or "local"
    made_of = "\n".join([base, lock.text, _TEMPLATE, *system])
    return f"envhub-worker-{slug}:{hashlib.sha256(made_of.encode()).hexdigest()[:16]}"


def dockerfile(base: str, lock: Lock, system: Sequence[str]) -> str:
    """Return the derived image's Dockerfile.
    ``system``: names of Debian packages, for the libraries that some wheels need.
    Raises ``DependencyError``: a name is invalid.
    """
    for name in system:
        if not _PACKAGE.fullmatch(name):
            raise DependencyError(f"{name!r} is not the name of a Debian package")
    install = ""
    if system:
        install = (
            "RUN apt-get update && apt-get install -y --no-install-recommends "
            f"{' '.join(system)} && rm -rf /var/lib/apt/lists/*\n"
        )
    return _TEMPLATE.format(
        base=base, system=install, starters=_STARTERS, lock_label=LOCK_LABEL, digest=lock.digest
    )


class DerivedImage(NamedTuple):
    """An image with a repository's packages: its tag, whether it was just built, the packages, and
    the imported modules for which undeclared packages were chosen.
    """

    tag: str
    is_new: bool
    lock: Lock
    taken: tuple[str, ...]


def derived(
    engine: Engine,
    base: str,
    request: PackageRequest,
    *,
    name: str = "packages",
    system: Sequence[str] = (),
    network: str | None = None,
    tell: Callable[[str], None] = lambda line: None,
) -> DerivedImage:
    """Derive the image with the requested packages; builds it unless the engine has it.

    Args:
        name: The repository's name, for the image's tag.
        system: Debian packages to install, too.
        network: The engine's name of the network for the build.

    Raises ``DependencyError``: the image cannot be built; the text says what to change;
    ``SandboxUnavailableError``: the base is not an image of envhub-worker, or does not exist.
    """
    identity, target = find_image(engine, base), target_of(engine, base)
    versions_asked = versions(request.python) & SpecifierSet(request.supports)
    if os.sep in request.python or not versions_asked.contains(f"{target.version}.99"):
        raise DependencyError(
            f"{request.source} asks for Python {request.python or request.supports}, and the image "
            f"has {target.version}: build envhub-worker from another base (docs/deployment.md)",
            reason="interpreter",
        )
    tell(f"choosing versions for {request.source}")
    lock, guesses = versions_for(request, lambda asked: resolve(asked, target, tell=tell))
    tag = tag_for(name, identity, lock, system)
    is_new = not exists(engine, tag)
    if is_new:
        tell(f"building the image {tag}")
        build(engine, dockerfile(base, lock, system), lock, tag, network)
    return DerivedImage(tag, is_new, lock, tuple(guess.module for guess in guesses))


class BuiltImageTarget(ImageTarget):
    """Packages for the Python of an image, in an image that is derived from it."""

    def __init__(self, engine: Callable[[], Engine], image: str, network: str | None) -> None:
        super().__init__(engine, image)
        self._network = network

    def make(self, request: PackageRequest, tell: Callable[[str], None]) -> PackageSet:
        """Derive an image, whose tag names its packages; raises as ``derived``."""
        engine = self._engine()
        packages = derived(engine, self._image, request, network=self._network, tell=tell)
        facts = {"lock": f"sha256:{packages.lock.digest}", "packages": packages.lock.packages}
        inferred = [guess.facts for guess in request.guesses if guess.module in packages.taken]
        return PackageSet(packages.tag, facts | ({"inferred": inferred} if inferred else {}))


def build(engine: Engine, recipe: str, lock: Lock, tag: str, network: str | None) -> None:
    """Build the image. Raises ``DependencyError``: the engine failed; the text has its output."""
    with tempfile.TemporaryDirectory(prefix="envhub-image-") as folder:
        (Path(folder) / "Dockerfile").write_bytes(recipe.encode())
        (Path(folder) / "requirements.lock").write_bytes(lock.text.encode())
        command = [engine.command, "build", "--tag", tag]
        command += [] if network is None else ["--network", network]
        done = subprocess.run(
            [*command, folder], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment()
        )
    if done.returncode != 0:
        output = printable(done.stdout.decode(errors="replace")[-4000:])  # names packages' files
        raise DependencyError(f"{engine.kind} could not build {tag}:\n{output}")


def exists(engine: Engine, tag: str) -> bool:
    """Whether the engine has an image."""
    with contextlib.suppress(EngineError):
        return bool(engine.run("image", "inspect", "--format", "{{.Id}}", tag))
    return False
