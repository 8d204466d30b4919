"""A repository's ``requirements.txt``: read as data, resolved to pins with hashes.

The file is a stranger's. pip and uv obey options, URLs and paths in such files, some of which
build and run code at once, so only plain requirements get through, each parsed and printed anew.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sysconfig
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import InvalidRequirement, Requirement

from envhub_sandbox.errors import DependencyError

FILE = "requirements.txt"
WORKERS = ("cloudpickle>=3", "gymnasium>=1.1", "msgpack>=1.0.5", "numpy>=1.26")
"""What the worker's jails import besides: the repository's versions must be among these."""
MAX_BYTES = 256 * 1024
_RESOLVE_S = 600.0


@dataclass(frozen=True)
class Lock:
    """Every package, pinned, with the hashes of its wheels.

    Attributes:
        text: As pip's ``--require-hashes`` reads it.
    """

    text: str

    @property
    def digest(self) -> str:
        """Hexadecimal SHA-256 of the text."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @property
    def packages(self) -> list[str]:
        """``name==version`` of each."""
        lines = [line.split()[0] for line in self.text.splitlines() if line[:1].isalnum()]
        return [line for line in lines if "==" in line]


def read(path: Path) -> list[Requirement]:
    """The plain requirements in a file.

    Raises:
        DependencyError: It holds something else, or is no text.
    """
    try:
        data = path.read_bytes()
        text = data.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DependencyError(f"{FILE} cannot be read: {error}") from error
    if len(data) > MAX_BYTES:
        raise DependencyError(f"{FILE} has {len(data)} bytes; at most {MAX_BYTES} are read")
    lines = [_without_comment(line) for line in text.splitlines()]
    return [_parsed(number, line) for number, line in enumerate(lines, start=1) if line]


def _without_comment(line: str) -> str:
    return "" if line.startswith("#") else line.split(" #", 1)[0].strip()


def _parsed(number: int, line: str) -> Requirement:
    try:
        requirement = Requirement(line)
    except InvalidRequirement as error:
        raise DependencyError(
            f"line {number} of {FILE} is {line[:200]!r}. Only plain requirements such as "
            "'numpy>=2' are taken: options, links, paths and files can build and run code while "
            "they are installed. If you trust them, write a Dockerfile (docs/deployment.md)"
        ) from error
    if requirement.url is not None:
        raise DependencyError(
            f"line {number} of {FILE} takes {requirement.name} from {requirement.url[:200]!r}; "
            "only packages of the index are installed. If you trust it, write a Dockerfile "
            "(docs/deployment.md)"
        )
    return requirement


def resolve(
    requirements: Sequence[Requirement],
    *,
    python: str,
    machine: str,
    exclude_newer: str | None = None,
) -> Lock:
    """Pins for an interpreter on Linux with glibc; wheels only, nothing is built.

    Args:
        requirements: What the repository asks for.
        python: The interpreter's version, ``"3.12"``.
        machine: As ``os.uname`` says it.
        exclude_newer: A date: packages of later are not seen.

    Raises:
        DependencyError: There is no solution, or no uv.
    """
    command = [
        *(_uv(), "pip", "compile", "-", "--no-config", "--no-build", "--generate-hashes"),
        *("--no-header", "--no-annotate", "--quiet", "--python-version", python),
        *("--python-platform", f"{machine}-manylinux_2_28"),
        *(() if exclude_newer is None else ("--exclude-newer", exclude_newer)),
    ]
    wanted = "".join(f"{one}\n" for one in [*map(str, requirements), *WORKERS])
    with tempfile.TemporaryDirectory(prefix="envhub-lock-") as nowhere:
        # uv reads projects and settings of the folder that it runs in
        try:
            done = subprocess.run(
                command,
                input=wanted,
                capture_output=True,
                cwd=nowhere,
                text=True,
                timeout=_RESOLVE_S,
            )
        except subprocess.TimeoutExpired as error:
            raise DependencyError(f"uv found no versions in {_RESOLVE_S:.0f} s") from error
    if done.returncode != 0:
        raise DependencyError(
            f"{FILE} cannot be had as wheels for Python {python} on {machine}:\n"
            f"{done.stderr[-4000:]}"
        )
    return Lock(done.stdout)


def _uv() -> str:
    # pip puts it next to the interpreter, which need not be on PATH
    path = os.pathsep.join([sysconfig.get_path("scripts"), os.environ.get("PATH", os.defpath)])
    found = shutil.which("uv", path=path)
    if found is None:
        raise DependencyError(
            "uv resolves the versions, and is not installed; run: "
            "pip install 'envhub-sandbox[image]'"
        )
    return found
