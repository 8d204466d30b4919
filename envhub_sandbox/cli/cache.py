"""``envhub cache``: lists and removes snapshots and environments, and leftovers of clients."""

from __future__ import annotations

import json as json_module
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import out, print_json, safe_line, say, show, show_rows
from envhub_sandbox.cli.shared.exits import Exit, UsageError
from envhub_sandbox.hub.grammar import FOLDER
from envhub_sandbox.system import extras
from envhub_worker.protocol.text import counted, size_text

_ENVIRONMENTS = "envhub_sandbox.extras.packages.environments"
_WHEELS = "envhub_sandbox.extras.packages.builds.wheels"
_DAY_S = 24 * 3600.0
_SHOWN = 18
"""The characters of a commit that are shown: ``local-`` and 12 digits; ``--json`` has all."""


class Stored(Protocol):
    """A snapshot, an environment of packages, or a wheel that was built here."""

    @property
    def used(self) -> float:
        """Unix time (seconds) of the last use."""

    @property
    def size(self) -> int:
        """Bytes of all files."""

    def answers_to(self, name: str) -> bool:
        """Whether a name means this entry."""


@dataclass(frozen=True)
class StoredSnapshot:
    """A snapshot in the store.

    Attributes:
        repository: ``"org/repo"``, with ``spaces/``, ``datasets/`` or ``git+https://HOST/`` in
            front; a package's id with ``pypi:``; for a folder ``"local"``.
        revision: The branch or tag by which it was downloaded, or None.
        used: Unix time (seconds) of the last use.
        size: Bytes of all files, as recorded.
        folder: For ``"local"``, the folder from which it was made; another folder with the same
            content has the same snapshot.
    """

    repository: str
    commit: str
    revision: str | None
    used: float
    size: int
    home: Path
    folder: str | None = None

    @property
    def name(self) -> str:
        """The entry's name for people."""
        return self.folder or self.repository

    def answers_to(self, name: str) -> bool:
        """Whether a name means this snapshot: the repository, the folder, the beginning of the
        commit, or ``REPOSITORY@COMMIT``.
        """
        if self.folder is not None and self.folder == os.path.abspath(name):
            return True
        repository, _, commit = name.partition("@")
        if commit and name != self.repository:
            return repository == self.repository and self.commit.startswith(commit)
        return name == self.repository or (len(name) >= 7 and self.commit.startswith(name))


def stored_snapshots() -> list[StoredSnapshot]:
    """Return the snapshots in the store, the last used first. Verifies nothing."""
    from envhub_sandbox.system.folders import cache_root

    folder = cache_root() / "snapshots"
    records = [*folder.glob("*/*/record.json"), *folder.glob("*/*/*/record.json")]
    snapshots = [_read(record) for record in records]
    return sorted(
        (snapshot for snapshot in snapshots if snapshot is not None),
        key=attrgetter("used"),
        reverse=True,
    )


def _read(record: Path) -> StoredSnapshot | None:
    try:
        document = json_module.loads(record.read_bytes())
        size = sum(row[1] for row in document["files"])
        used = record.stat().st_mtime
    except (OSError, ValueError, LookupError, TypeError):
        return None
    home = record.parent
    revision = document.get("revision")
    kind, name = document.get("repo_type"), str(document.get("repo_id"))
    prefixes = {"space": "spaces/", "dataset": "datasets/", "pypi": "pypi:"}
    prefixes["git"] = f"git+{document.get('endpoint')}/"
    repository = FOLDER if kind == FOLDER else prefixes.get(str(kind), "") + name
    folder = str(document.get("repo_id")) if repository == FOLDER else None
    return StoredSnapshot(repository, home.name, revision, used, size, home, folder)


@opt.with_options()
def list_(json: opt.Json = False) -> None:
    """List snapshots, environments of packages and wheels built here, last used first."""
    from envhub_sandbox.system.folders import cache_root

    snapshots, environments, built = stored_snapshots(), _every(_ENVIRONMENTS), _every(_WHEELS)
    if json:
        names = ("repository", "commit", "revision", "folder")
        own = _documents(snapshots, **dict(zip(names, names, strict=True)))
        theirs = _documents(
            environments, name="key", python="python", version="version", packages="pins"
        )
        folder = str(cache_root())
        kept = _documents(built, file="file")
        print_json({"folder": folder, "snapshots": own, "environments": theirs, "wheels": kept})
        return
    if snapshots:
        lines = [
            (entry.name, entry.commit[:_SHOWN], entry.revision or "", *_when_and_size(entry))
            for entry in snapshots
        ]
        heads = ("repository", "commit", "revision", "last used", "size")
        show_rows([heads, *lines], right=(4,))
    if snapshots and environments:
        out()
    if environments:
        rows = [
            (entry.key[:12], entry.version, *_when_and_size(entry), " ".join(entry.pins))
            for entry in environments
        ]
        show_rows([("environment", "Python", "last used", "size", "packages"), *rows], right=(3,))
    if built:
        out()
        files = [(wheel.file, *_when_and_size(wheel)) for wheel in built]
        show_rows([("wheel built here", "last used", "size"), *files], right=(2,))
    say(f"{_told(snapshots, environments, built)}, in {cache_root()}")


def _every(module: str) -> list[Any]:
    """Return the entries that an extra has stored; empty if the extra is not installed."""
    every = extras.find(module, "every")
    return [] if every is None else list(every())


def _told(snapshots: list[StoredSnapshot], environments: list[Any], built: list[Any]) -> str:
    everything: list[Stored] = [*snapshots, *environments, *built]
    total = sum(entry.size for entry in everything)
    texts = [counted(len(snapshots), "snapshot"), counted(len(environments), "environment")]
    texts += [counted(len(built), "wheel")] if built else []
    return f"{', '.join(texts)}, {size_text(total)}"


def _documents(entries: Sequence[Stored], **named: str) -> list[dict[str, Any]]:
    """Return entries as data. ``named``: the attribute for each further field."""
    return [
        {
            **{name: getattr(entry, attribute) for name, attribute in named.items()},
            "last_used": time.strftime("%FT%TZ", time.gmtime(entry.used)),
            "bytes": entry.size,
        }
        for entry in entries
    ]


def _when_and_size(entry: Stored) -> tuple[str, str]:
    return time.strftime("%F", time.localtime(entry.used)), size_text(entry.size)


@opt.with_options()
def remove(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME]...",
            help="A repository, repository@commit, a folder that is here, at least 7 characters of "
            "a commit or of an environment, or the package of a wheel that was built here.",
        ),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Everything, cached descriptions and versions included.")
    ] = False,
    unused_for: Annotated[
        float | None,
        typer.Option(metavar="DAYS", min=0, help="What was not used for this many days."),
    ] = None,
) -> None:
    """Remove snapshots and environments of packages that are not in use, and built wheels."""
    from envhub_sandbox.system.folders import cache_root

    snapshots, environments, built = stored_snapshots(), _every(_ENVIRONMENTS), _every(_WHEELS)
    if everything:
        for folder in ("imports", "manifests", "resolutions"):
            shutil.rmtree(cache_root() / folder, ignore_errors=True)
    else:
        is_chosen = _chooser([*snapshots, *environments, *built], names or [], unused_for)
        snapshots = [*filter(is_chosen, snapshots)]
        environments = [*filter(is_chosen, environments)]
        built = [*filter(is_chosen, built)]
    kept = {entry.commit: why for entry in snapshots if (why := _users_of(entry))}
    if remove_environment := extras.find(_ENVIRONMENTS, "remove"):
        kept |= {entry.key: why for entry in environments if (why := remove_environment(entry))}
        extras.find(_ENVIRONMENTS, "remove_abandoned")()
    for wheel in built:
        wheel.remove()
    gone = [entry for entry in snapshots if entry.commit not in kept]
    say(
        f"Removed {_told(gone, [entry for entry in environments if entry.key not in kept], built)}."
    )
    if kept and names:
        raise UsageError("; ".join(kept.values()))
    for why in kept.values():
        say(f"Kept: {why}.")


def _users_of(snapshot: StoredSnapshot) -> str:
    """Remove a snapshot unless processes use it; returns a text that names them, or empty."""
    from envhub_sandbox.hub import store

    users = [f"process {pid} ({command})" for pid, command in store.remove(snapshot.home).items()]
    if not users:
        return ""
    return (
        f"the snapshot {snapshot.repository}@{snapshot.commit[:12]} is in use by "
        f"{', '.join(users)}. Close its environments in that process, or end the process"
    )


def _chooser(
    everyone: Sequence[Stored], names: list[str], unused_for: float | None
) -> Callable[[Stored], bool]:
    for name in names:
        if not any(entry.answers_to(name) for entry in everyone):
            raise UsageError(f"the cache has nothing named {name!r}; see: envhub cache list")
    oldest = None if unused_for is None else time.time() - unused_for * _DAY_S

    def is_chosen(entry: Stored) -> bool:
        if not names and oldest is None:
            return False
        meant = not names or any(entry.answers_to(name) for name in names)
        return meant and (oldest is None or entry.used < oldest)

    return is_chosen


@opt.with_options()
def gc(
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", "-n", help="List what would be removed, and remove nothing."),
    ] = False,
    json: opt.Json = False,
) -> None:
    """Remove containers, runtime folders and control groups whose client is gone.

    Usually there are none, because they end with the client. What belongs to a running client, to
    another user, or to clients on another machine that share the engine stays; root removes the
    containers and control groups of all users. Exit code 9: an installed engine did not answer.
    """
    find = extras.required("envhub_sandbox.extras.docker.leftovers", "find", "envhub cache gc")
    leftovers, unasked = find()
    removed = [] if dry_run else [leftover for leftover in leftovers if leftover.remove()]
    if json:
        items = [
            {"kind": leftover.kind, "name": leftover.name, "removed": leftover in removed}
            for leftover in leftovers
        ]
        print_json({"found": items, "unasked": unasked})
    for leftover in () if json else leftovers:
        done = "removed" if leftover in removed else "found" if dry_run else "not removed"
        show(done, f"{leftover.kind} {leftover.name}")
    for engine, why in unasked.items():
        reason = safe_line(why, 500)
        say(f"{engine} could not be asked, so its containers are not known: {reason}")
    if not json:
        say(f"{len(leftovers)} left behind, {len(removed)} removed.")
    if unasked:
        raise typer.Exit(Exit.UNASKED)
