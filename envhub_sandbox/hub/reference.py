"""Hub references: ``[models/|spaces/|datasets/]owner/name[@revision][:path]``, and Hub URLs.

A reference is text that somebody pasted, so every form that can mean only one thing works, and
for every other form the error says what to write instead. Extends the grammar of
``lerobot.envs.utils._parse_hub_url``. Nothing is asked of the network.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from envhub_sandbox.errors import HubReferenceError
from envhub_sandbox.hub.grammar import (
    DEFAULT_PATH,
    GRAMMAR,
    REPO_TYPES,
    Parts,
    Wrong,
    check,
    is_commit,
    is_local,
    join,
    read,
)

__all__ = ["DEFAULT_PATH", "REPO_TYPES", "HubRef", "is_local"]


@dataclass(frozen=True)
class HubRef:
    """One environment file of one repository, at one revision.

    Attributes:
        repo_id: ``"owner/name"``.
        revision: A branch, tag, pull request (``"refs/pr/3"``) or commit; None for ``main``.
        path: The entry file, relative to the repository's root, with ``/``.
        repo_type: ``"model"``, ``"space"`` or ``"dataset"``; None for "model first, then space".

    Raises:
        HubReferenceError: When a part is not what the Hub could have.
    """

    repo_id: str
    revision: str | None = None
    path: str = DEFAULT_PATH
    repo_type: str | None = None

    def __post_init__(self) -> None:
        try:
            check(self._parts())
        except Wrong as wrong:
            raise _refusal(str(self), wrong) from None

    @classmethod
    def parse(cls, text: str) -> HubRef:
        """Read a reference, a Hub URL or an ``hf://`` path.

        Raises:
            HubReferenceError: The text names the reference and what to write instead.
        """
        if not isinstance(text, str):
            raise HubReferenceError(f"a hub reference is a str ({GRAMMAR}), got {text!r}")
        try:
            parts = read(text.strip())
            check(parts)
        except Wrong as wrong:
            raise _refusal(text, wrong) from None
        return cls(parts.repo_id, parts.revision, parts.path, parts.repo_type)

    def __str__(self) -> str:
        return join(self._parts())

    @property
    def is_pinned(self) -> bool:
        """Whether the revision is a full commit, which can never mean anything else."""
        return self.revision is not None and is_commit(self.revision)

    def _parts(self) -> Parts:
        return Parts(self.repo_id, self.revision, self.path, self.repo_type)


def _refusal(text: str, wrong: Wrong) -> HubReferenceError:
    # A pasted URL may carry a token in front of its host; errors end up in logs.
    shown = re.sub(r"://(?!git@)[^/]*@", "://***@", text)
    return HubReferenceError(f"hub reference {shown!r}: {wrong.what}; write {wrong.write}")
