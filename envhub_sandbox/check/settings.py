"""Settings of a judgement that stand in files: the caller's policy, and what an author asks for.

The caller's file may say whatever ``Policy`` takes. An author's ``envhub.toml`` lies in the
repository that is judged: it is a stranger's, read as data of bounded size, and can make the
judgement longer or stricter, within bounds, and never anything else.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envhub_sandbox.check import parsing
from envhub_sandbox.errors import PolicyError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_worker.protocol.text import printable

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

AUTHORS = "envhub.toml"
_MOST_BYTES = 16 << 10
_MOST = {"steps": 2_000, "resets": 100}
"""What an author can ask for: a judge's time is not his."""


@dataclass(frozen=True)
class Asks:
    """What an author asks for.

    Attributes:
        steps, resets: Of each play; more than the judge would take, or as many.
        refused: What was not taken, and why.
    """

    steps: int
    resets: int
    refused: tuple[str, ...] = ()


def policy(path: Path) -> dict[str, Any]:
    """What a caller's file permits: the fields of ``Policy``, limits as a table of their own.

    Raises:
        PolicyError: It cannot be read. Whether its fields are such is for ``make_env`` to say.
    """
    try:
        with path.open("rb") as file:
            text = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise PolicyError(f"the policy {path} cannot be read: {error.strerror}") from error
    try:
        return _toml(text)
    except ValueError as error:
        raise PolicyError(f"the policy {path} is no TOML: {error}") from error


def merged(policy: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """A file's policy, changed by what was given as options, limit by limit.

    Raises:
        PolicyError: The file's limits are no table.
    """
    limits = policy.get("limits", {})
    if not isinstance(limits, Mapping):
        raise PolicyError("limits are a table: [limits], with a line for each")
    both = {**limits, **given.get("limits", {})}
    return {**policy, **given, **({"limits": both} if both else {})}


def of_the_author(snapshot: Snapshot, steps: int, resets: int) -> Asks:
    """What a repository's own file asks for, as far as it is granted.

    Args:
        snapshot: The repository.
        steps, resets: What the judge takes in any case; 0 resets ask nothing, whoever wants some.
    """
    asks = Asks(steps, resets)
    if AUTHORS not in {record.path for record in snapshot.files}:
        return asks
    data = parsing.content(snapshot.root / AUTHORS, _MOST_BYTES)
    if data is None:
        return Asks(steps, resets, (f"{AUTHORS} is larger than {_MOST_BYTES} bytes",))
    try:
        table = _toml(data).get("check", {})
    except ValueError as error:
        return Asks(steps, resets, (printable(f"{AUTHORS} is no TOML: {error}", 300),))
    if not isinstance(table, Mapping):
        return Asks(steps, resets, (f"[check] of {AUTHORS} is no table",))
    return _granted(table, {"steps": steps, "resets": resets})


def _granted(table: Mapping[str, Any], least: Mapping[str, int]) -> Asks:
    taken, refused = dict(least), []
    for name in sorted(table)[:_MOST_BYTES]:
        why = _why_not(name, table[name], least)
        if why:
            refused.append(printable(f"{AUTHORS}: {name} {why}", 300))
        else:
            taken[name] = max(table[name], least[name])
    return Asks(**taken, refused=tuple(refused[:10]))


def _why_not(name: str, value: Any, known: Collection[str]) -> str:
    if name not in known:
        return f"is not the author's to say; {' and '.join(known)} are"
    if type(value) is not int or not 0 <= value <= _MOST[name]:
        return f"is a whole number up to {_MOST[name]}"
    return ""


def _toml(data: bytes) -> dict[str, Any]:
    """A document; ``ValueError`` of what is none, or too large."""
    if len(data) > _MOST_BYTES:
        raise ValueError(f"it is larger than {_MOST_BYTES} bytes")
    try:
        document: dict[str, Any] = tomllib.loads(data.decode("utf-8"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    return document
