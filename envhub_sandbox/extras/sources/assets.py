"""Fetches further Hub repositories that a jail may read: those of ``assets=`` and of the card.

They are fetched and verified like an environment's own files. The caller's may be private. Those of
the author's card or of a lock are read without a login, also from the store: neither may bring the
caller's private data into a jail. A card names full commits only. It declares them in the
``envhub:`` mapping of the YAML in front of README.md::

    ---
    envhub:
      assets:
        - org/weights@0123456789abcdef0123456789abcdef01234567
        - datasets/org/scenes@89abcdef0123456789abcdef0123456789abcdef
    ---

Trust: the card is a stranger's. Up to ``_MAX_BYTES`` of it are read as a tree of nodes, without
constructing objects and without following anchors and merges.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import EnvHubError, HubReferenceError, SnapshotError
from envhub_sandbox.hub.listing import DEFAULT_LIMITS, SnapshotLimits
from envhub_sandbox.hub.reference import DEFAULT_PATH, REPO_TYPES, HubRef, is_local
from envhub_sandbox.hub.snapshot import Snapshot, fetch
from envhub_sandbox.settings.options import MAX_ASSETS, option_name
from envhub_sandbox.system.log import SNAPSHOT, progress_shown

CARD = "README.md"
_MAX_BYTES = 64 * 1024
_MAX_CHARS = 500
_FRONT = re.compile(r"\A\ufeff?---[ \t]*\r?\n(.*?)^---[ \t]*\r?$", re.DOTALL | re.MULTILINE)


class CardError(ValueError):
    """The card has an unreadable declaration; the text names it."""


def declared_assets(root: Path) -> list[str]:
    """Returns the repositories that a card declares as assets, as written; or ``CardError``."""
    try:
        with (root / CARD).open("rb") as file:
            text = file.read(_MAX_BYTES).decode("utf-8", "replace")
    except OSError:
        return []
    front = _FRONT.match(text)
    if front is None or "envhub" not in front[1]:
        return []
    ours = _value(_tree(front[1]), "envhub")
    if ours is None:
        return []
    assets = _value(ours, "assets")
    rows = getattr(assets, "value", None)
    if assets is None or assets.id != "sequence" or not isinstance(rows, list):
        raise CardError("'envhub' in its YAML takes 'assets', a list of repositories")
    if len(rows) > MAX_ASSETS:
        raise CardError(f"it declares {len(rows)} assets, and at most {MAX_ASSETS} are taken")
    if any(row.id != "scalar" for row in rows):
        raise CardError("each of its assets is a text, as in 'org/data@COMMIT'")
    if any(len(row.value) > _MAX_CHARS for row in rows):
        raise CardError(f"one of its assets has more than {_MAX_CHARS} characters")
    return [str(row.value) for row in rows]


def _tree(text: str) -> Any:
    import yaml  # type: ignore[import-untyped]  # comes with huggingface_hub

    try:
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except (yaml.YAMLError, ArithmeticError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 2}" if mark else ""  # the first line is the ---
        raise CardError(f"its YAML cannot be read: {type(error).__name__}{line}") from None


def _value(node: Any, key: str) -> Any:
    """Returns a mapping's value for a key; None for another node or a missing key."""
    if getattr(node, "id", "") != "mapping":
        return None
    return next((value for name, value in node.value if name.value == key), None)


def with_assets(
    snapshot: Snapshot, given: Sequence[str], hub: Mapping[str, Any], locked: Sequence[str] = ()
) -> Snapshot:
    """Returns the snapshot with its assets, fetched and verified.

    Args:
        given: The caller's references, or else those of a lock (``locked``). A reference replaces
            the card's for the same repository.
        hub: Arguments for ``fetch``.

    Raises as ``fetch``, and for an unreadable card or a reference that is no asset.
    """
    where = option_name("assets") if given else "the lock"
    wanted = [_asset(text, snapshot, where) for text in given or locked]
    declared = _declared(snapshot)
    if not wanted and not declared:
        return snapshot
    with progress_shown("assets") as tell:
        hub = dict(hub) if given else {**hub, "public": True}
        snapshots = [_fetched(ref, where, tell, hub) for ref in wanted]
        theirs = {(asset.repo_type, asset.repo_id.casefold()) for asset in snapshots}
        left = DEFAULT_LIMITS.max_bytes
        for ref in declared:
            if any(_may_be(ref, *their) for their in theirs):
                continue
            limits = replace(DEFAULT_LIMITS, max_bytes=max(1, left))
            taken = _fetched(ref, f"its {CARD}", tell, {**hub, "public": True}, limits)
            left -= sum(file.size for file in taken.files)
            snapshots.append(taken)
            SNAPSHOT.info(
                "%s: its %s declares %s as an asset, which the environment can read",
                *(snapshot.label, CARD, taken.pinned),
            )
    _check_distinct(snapshot, snapshots)
    return replace(snapshot, assets=tuple(snapshots))


def _declared(snapshot: Snapshot) -> list[HubRef]:
    try:
        texts = declared_assets(snapshot.root)
    except CardError as error:
        raise SnapshotError(f"{snapshot.label}: its {CARD} is refused: {error}") from error
    refs = [_asset(text, snapshot, f"its {CARD}") for text in texts]
    for ref in refs:
        if not ref.is_pinned:
            raise HubReferenceError(
                f"{snapshot.label}: its {CARD} declares the asset {str(ref)!r}; a card can name "
                "full commits only, as in 'org/data@<40 hex digits>'. Give the asset with "
                f"{option_name('assets')} instead"
            )
    return refs


def _asset(text: str, snapshot: Snapshot, where: str) -> HubRef:
    masked = re.sub(r"://[^/]*@", "://***@", text)  # a pasted URL may carry a token
    shown = repr(masked[:200])
    names_file = re.search(r":(?!//)", masked) is not None
    elsewhere = HubReferenceError(
        f"{snapshot.label}: {where} holds {shown}; an asset is a repository of the Hub, as in "
        "'org/data@COMMIT'"
    )
    if is_local(masked) or re.match(r"(git\+https|github|pypi|examples):", masked, re.IGNORECASE):
        raise elsewhere
    try:
        ref = HubRef.parse(text)
        names_file |= ref.path != DEFAULT_PATH
    except HubReferenceError as error:
        if not names_file:
            error.args = (f"{snapshot.label}: {where} holds {shown}: {error}",)
            raise
    if names_file:
        raise HubReferenceError(
            f"{snapshot.label}: {where} holds {shown}, which names a file; an asset is a whole "
            "repository, as in 'org/data@COMMIT'"
        )
    if ref.repo_type not in (None, *REPO_TYPES):  # else a card would choose the host to contact
        raise elsewhere
    if _may_be(ref, snapshot.repo_type, snapshot.repo_id.casefold()):
        raise HubReferenceError(
            f"{snapshot.label}: {where} holds {shown}, which is the environment's own repository; "
            "its files are already available"
        )
    return ref


def _may_be(ref: HubRef, repo_type: str, repo_id: str) -> bool:
    return ref.repo_id.casefold() == repo_id and ref.repo_type in (None, repo_type)


def _fetched(
    ref: HubRef,
    where: str,
    tell: Callable[[str], None],
    hub: Mapping[str, Any],
    limits: SnapshotLimits = DEFAULT_LIMITS,
) -> Snapshot:
    tell(str(ref).partition(":")[0])
    try:
        return fetch(ref, **hub, limits=limits, needs_entry=False)
    except EnvHubError as error:
        option, why = option_name("assets"), ""
        if where != option:
            why = f", and it is fetched without a login. If it is meant, name it by {option}"
        error.args = (f"{error}\nIt is an asset: {where} names it{why}.", *error.args[1:])
        raise


def _check_distinct(snapshot: Snapshot, found: Sequence[Snapshot]) -> None:
    shown: dict[tuple[str, str], Snapshot] = {}
    for one in found:
        other = shown.setdefault((one.repo_type, one.repo_id.casefold()), one)
        if other is not one:
            raise HubReferenceError(
                f"{snapshot.label}: {other.pinned} is an asset, and {one.pinned} too; a repository "
                "is shown once, at one commit: leave one of them out"
            )
