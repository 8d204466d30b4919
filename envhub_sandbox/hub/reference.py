"""Hub references: ``[models/|spaces/|datasets/]owner/name[@revision][:path]``, and Hub URLs.

The extra ``sources`` adds references of a commit of git (``git_address``) and of an environment
that a package of the index registers (``registered``). Each of these modules has a ``read`` and a
``check``, like ``hub.grammar``. Users paste references, so every form that can mean only one thing
works, and for every other form the error says what to write instead. Extends the grammar of
``lerobot.envs.utils._parse_hub_url``. Sends no requests.
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
    """A kind of references outside of the Hub: how they begin, and the module that reads them."""

    kind: str
    module: str
    starts: tuple[str, ...]

    def function(self, name: str) -> Any:
        """A function of its module. Raises ``SandboxUnavailableError``: that is not installed."""
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
        repo_id: ``"owner/name"``; for git ``"https://host/org/repo"``; for a package
            ``"name[extra]#id"``.
        revision: A branch, tag, pull request (``"refs/pr/3"``) or commit; None for ``main``, or for
            ``HEAD`` of git. For a package its version; None for any version.
        path: The entry file, relative to the repository's root, with ``/``.
        repo_type: ``"model"``, ``"space"`` or ``"dataset"``; None for "model first, then space";
            ``"git"``; ``"pypi"`` for a package.

    Raises:
        HubReferenceError: The Hub cannot have one of the parts.
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
            HubReferenceError: The text cannot be read; the error says what to write instead.
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
        """Whether the revision is a full commit, whose meaning never changes."""
        return self.repo_type != PYPI and is_commit(self.revision or "")

    @property
    def meaning(self) -> str:
        """The canonical text, which is equal for all references of the same meaning."""
        return grammar.join(self.parts._replace(revision=self.usual_revision))

    @property
    def usual_revision(self) -> str | None:
        """The revision, or the default one if there is none."""
        return self.revision or {GIT: "HEAD", PYPI: None}.get(self.repo_type or "", "main")

    @property
    def parts(self) -> Parts:
        """The fields of the reference."""
        return Parts(self.repo_id, self.revision, self.path, self.repo_type)


def pinned(repo_type: str, repo_id: str, commit: str, path: str) -> str:
    """``Snapshot.reference`` from the fields of a provenance, which may be a stranger's."""
    if repo_type in LOCAL_TYPES:
        return local_reference(repo_type, repo_id, path)
    if repo_type == PYPI:
        return str(HubRef.parse(f"{repo_type}:{repo_id}"))
    return str(HubRef(repo_id, commit, path, repo_type))


def is_of_another_place(text: str) -> bool:
    """Whether a reference is of git or of the package index, by its beginning."""
    return _scheme_of(text.strip()) is not None


def _scheme_of(text: str) -> _Scheme | None:
    return next((item for item in _SCHEMES if text.lower().startswith(item.starts)), None)


def _check(parts: Parts) -> None:
    scheme = next((item for item in _SCHEMES if item.kind == parts.repo_type), None)
    check: Callable[[Parts], None] = scheme.function("check") if scheme else grammar.check
    check(parts)


def _refusal(text: str, wrong: Wrong) -> HubReferenceError:
    # A pasted URL may have a token before its host, and errors end up in logs.
    shown = re.sub(r"://(?!git@)[^/]*@", "://***@", text)
    return HubReferenceError(f"hub reference {shown!r}: {wrong.what}; write {wrong.write}")
