"""Packages that come as sources: what was chosen and has no wheel, and what makes one of it."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from envhub_sandbox.dependencies.interpreters import Interpreter

_GIT = re.compile(
    r"git\+(?P<url>https://[A-Za-z0-9.-]+(:\d{1,5})?/[A-Za-z0-9._~/-]+?)"
    r"(?:@(?P<revision>[A-Za-z0-9._/-]{1,200}))?(#subdirectory=(?P<folder>[A-Za-z0-9._/-]{1,200}))?"
)


@dataclass(frozen=True)
class Source:
    """What was chosen and has no wheel.

    Attributes:
        name: Its canonical name.
        version: Empty for a repository of git.
        url: Of the source distribution, or of the repository.
        sha256: Of the source distribution; empty for git.
        commit: What a requirement names in a repository: a commit, a tag or a branch; or ``HEAD``.
        subdirectory: Where the project lies in there.
        where: The line that asks for it, for errors.
    """

    name: str
    version: str = ""
    url: str = ""
    sha256: str = ""
    commit: str = ""
    subdirectory: str = ""
    where: str = ""

    @property
    def identity(self) -> str:
        """What names its content: the hash of a file, or a full commit."""
        if not self.commit:
            return f"sha256:{self.sha256}"
        below = f"#subdirectory={self.subdirectory}" if self.subdirectory else ""
        return f"git+{self.url}@{self.commit}{below}"


@dataclass(frozen=True)
class WheelOrigin:
    """What a wheel was built of: its source, the digest of the lock of the packages that it was
    built with, and its own SHA-256.
    """

    source: Source
    environment: str
    wheel: str


Builder = Callable[[Sequence[Source], Interpreter, Callable[[str], None]], Sequence[Path]]
"""Makes one wheel of each source, in the same order; each lies in a folder of wheels alone, and
stays there. Raises ``DependencyError``."""


def of_git(requirement: Requirement, where: str) -> Source | None:
    """The repository that a requirement names; None for what is no ``git+https`` at a revision."""
    found = _GIT.fullmatch(requirement.url or "")
    if found is None or ".." in found[0]:
        return None
    return Source(
        canonicalize_name(requirement.name),
        url=found["url"],
        commit=found["revision"] or "HEAD",
        subdirectory=found["folder"] or "",
        where=where,
    )
