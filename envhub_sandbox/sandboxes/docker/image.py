"""Deriving an image for one repository: its packages in an interpreter of their own.

The server's interpreter stays as it is. The repository's packages go into ``/opt/environment``,
where the worker looks for the interpreter of its jails, and whatever would run at the start of
every interpreter is left out of it.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from envhub_sandbox.dependencies.resolve import Lock, Target
from envhub_sandbox.errors import DependencyError
from envhub_sandbox.sandboxes.docker.engines import Engine, EngineError, environment
from envhub_sandbox.sandboxes.docker.packages import image_packages

LOCK_LABEL = "dev.envhub.lock"
_PACKAGE = re.compile(r"[a-z0-9][a-z0-9.+-]+")

# An interpreter runs these at its start, before anything could confine it.
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
    """What runs in a worker's image; raises as ``image_packages``."""
    found, _ = image_packages(engine, image)
    return Target(version=".".join(found.version.split(".")[:2]), machine=found.machine)


def tag_for(repository: str, base: str, lock: Lock, system: Sequence[str]) -> str:
    """The derived image's name: the repository's, and the hash of all that it is made of."""
    slug = re.sub(r"[^a-z0-9]+", "-", repository.lower()).strip("-")[-60:] or "local"
    made_of = "\n".join([base, lock.text, _TEMPLATE, *system])
    return f"envhub-worker-{slug}:{hashlib.sha256(made_of.encode()).hexdigest()[:16]}"


def dockerfile(base: str, lock: Lock, system: Sequence[str]) -> str:
    """The derived image's recipe.
    ``system``: Debian packages, for the libraries that some wheels need.
    Raises ``DependencyError``: one of these is no name of a package.
    """
    for name in system:
        if not _PACKAGE.fullmatch(name):
            raise DependencyError(f"{name!r} is no name of a Debian package")
    install = ""
    if system:
        install = (
            "RUN apt-get update && apt-get install -y --no-install-recommends "
            f"{' '.join(system)} && rm -rf /var/lib/apt/lists/*\n"
        )
    return _TEMPLATE.format(
        base=base, system=install, starters=_STARTERS, lock_label=LOCK_LABEL, digest=lock.digest
    )


def build(engine: Engine, recipe: str, lock: Lock, tag: str, network: str | None) -> None:
    """Build the image; what the engine says goes to stderr. Raises ``DependencyError``."""
    with tempfile.TemporaryDirectory(prefix="envhub-image-") as folder:
        (Path(folder) / "Dockerfile").write_text(recipe)
        (Path(folder) / "requirements.lock").write_text(lock.text)
        command = [engine.command, "build", "--tag", tag]
        command += [] if network is None else ["--network", network]
        done = subprocess.run(
            [*command, folder], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment()
        )
    if done.returncode != 0:
        said = done.stdout.decode(errors="replace")[-4000:]
        raise DependencyError(f"{engine.kind} could not build {tag}:\n{said}")


def exists(engine: Engine, tag: str) -> bool:
    """Whether the engine has an image."""
    with contextlib.suppress(EngineError):
        return bool(engine.run("image", "inspect", "--format", "{{.Id}}", tag))
    return False
