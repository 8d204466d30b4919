"""Hub references: ``[models/|spaces/|datasets/]owner/name[@revision][:path]``, and Hub URLs.

And of the extra ``sources``: a commit of git (``git_address``), and an environment that a package
of the index registers (``registered``). ``read`` and ``check`` of such a module are to its
references what those of ``hub.grammar`` are to the Hub's. A reference is text that somebody pasted,
so every form that can mean only one thing works, and for every other form the error says what to
write instead. Extends the grammar of ``lerobot.envs.utils._parse_hub_url``. Nothing is asked of the
network.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, NamedTuple

from envhub_sandbox.errors import HubReferenceError
from envhub_sandbox.hub import grammar
from envhub_sandbox.hub.grammar import (
    DEFAULT_PATH,
    LOCAL_TYPES,
    REPO_TYPES,
    Parts,
    Wrong,
    is_commit,
    is_local,
    local_reference,
)
from envhub_sandbox.system import extras
from envhub_worker.protocol.records import dataclass

__all__ = ["DEFAULT_PATH", "REPO_TYPES", "HubRef", "is_local", "is_of_another_place", "pinned"]


class _Scheme(NamedTuple):
    """References that are none of the Hub's: how they begin, and the module that reads them."""

    kind: str
    module: str
    starts: tuple[str, ...]

    def function(self, name: str) -> Any:
        """A function of the module. Raises ``SandboxUnavailableError``: it is not installed."""
        return extras.required(self.module, name, f"a reference of {self.kind}")


GIT, PYPI = "git", "pypi"
_SCHEMES = (
    _Scheme(
        GIT,
        "envhub_sandbox.extras.sources.git_address",
        (
            *("git+http:", "git+https:", "git+file:", "git+ext:", "github:"),
            *("https://github.com/", "https://www.github.com/", "github.com/"),
        ),
    ),
    _Scheme(PYPI, "envhub_sandbox.extras.sources.registered", ("pypi:",)),
)


@dataclass(frozen=True)
class HubRef:
    """One environment file of one repository, at one revision.

    Attributes:
        repo_id: ``"owner/name"``; of git ``"https://host/org/repo"``; of a package
            ``"name[extra]#id"``.
        revision: A branch, tag, pull request (``"refs/pr/3"``) or commit; None for ``main``, and of
            git for ``HEAD``. Of a package its version; None for any.
        path: The entry file, relative to the repository's root, with ``/``.
        repo_type: ``"model"``, ``"space"`` or ``"dataset"``; None for "model first, then space";
            ``"git"``; ``"pypi"`` for a package.

    Raises:
        HubReferenceError: When a part is not what the Hub could have.
    """

    repo_id: str
    revision: str | None = None
    path: str = DEFAULT_PATH
    repo_type: str | None = None

    def __post_init__(self) -> None:
        try:
            _check(self.parts)
        except Wrong as wrong:
            raise _refusal(str(self), wrong) from None

    @classmethod
    def parse(cls, text: str) -> HubRef:
        """Read a reference, a Hub URL or an ``hf://`` path.

        Raises:
            HubReferenceError: The text names the reference and what to write instead.
        """
        if not isinstance(text, str):
            raise HubReferenceError(f"a hub reference is a str ({grammar.GRAMMAR}), got {text!r}")
        try:
            plain = text.strip()
            scheme = _scheme_of(plain)
            read: Callable[[str], Parts] = scheme.function("read") if scheme else grammar.read
            parts = read(plain)
            _check(parts)
        except Wrong as wrong:
            raise _refusal(text, wrong) from None
        return cls(parts.repo_id, parts.revision, parts.path, parts.repo_type)

    def __str__(self) -> str:
        return grammar.join(self.parts)

    @property
    def is_pinned(self) -> bool:
        """Whether the revision is a full commit, which can never mean anything else."""
        return self.repo_type != PYPI and is_commit(self.revision or "")

    @property
    def meaning(self) -> str:
        """The same for every way to write it."""
        return grammar.join(self.parts._replace(revision=self.usual_revision))

    @property
    def usual_revision(self) -> str | None:
        """The revision, or what none means."""
        return self.revision or {GIT: "HEAD", PYPI: None}.get(self.repo_type or "", "main")

    @property
    def parts(self) -> Parts:
        """Its fields."""
        return Parts(self.repo_id, self.revision, self.path, self.repo_type)


def pinned(repo_type: str, repo_id: str, commit: str, path: str) -> str:
    """``Snapshot.reference``, by what a provenance says of it, which may be a stranger's."""
    if repo_type in LOCAL_TYPES:
        return local_reference(repo_type, repo_id, path)
    if repo_type == PYPI:
        return str(HubRef.parse(f"{repo_type}:{repo_id}"))
    return str(HubRef(repo_id, commit, path, repo_type))


def is_of_another_place(text: str) -> bool:
    """Whether it is of git or of the package index, by how it begins."""
    return _scheme_of(text.strip()) is not None


def _scheme_of(text: str) -> _Scheme | None:
    return next((item for item in _SCHEMES if text.lower().startswith(item.starts)), None)


def _check(parts: Parts) -> None:
    scheme = next((item for item in _SCHEMES if item.kind == parts.repo_type), None)
    check: Callable[[Parts], None] = scheme.function("check") if scheme else grammar.check
    check(parts)


def _refusal(text: str, wrong: Wrong) -> HubReferenceError:
    # A pasted URL may carry a token in front of its host; errors end up in logs.
    shown = re.sub(r"://(?!git@)[^/]*@", "://***@", text)
    return HubReferenceError(f"hub reference {shown!r}: {wrong.what}; write {wrong.write}")
