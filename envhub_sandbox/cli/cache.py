"""``envhub cache``: what lies in the store of snapshots, and how it gets away."""

from __future__ import annotations

import json as json_module
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from envhub_sandbox.cli.shared.console import console, print_json, safe_line, say
from envhub_sandbox.cli.shared.exits import UsageError, reported

app = typer.Typer(
    help="List and remove what was downloaded.", no_args_is_help=True, rich_markup_mode="rich"
)

_DAY_S = 24 * 3600.0


@dataclass(frozen=True)
class Stored:
    """A snapshot in the store.

    Attributes:
        repository: ``"org/repo"``, with ``spaces/`` or ``datasets/`` in front; ``"local"``.
        revision: The branch or tag that it was fetched as, or None.
        used: Unix time (seconds) of the last use.
        size: Bytes of all files, as the record has them.
        home: Its folder.
    """

    repository: str
    commit: str
    revision: str | None
    used: float
    size: int
    home: Path

    def answers_to(self, name: str) -> bool:
        """Whether a name means it: the repository, a commit's beginning, or both with ``@``."""
        repository, _, commit = name.partition("@")
        if commit:
            return repository == self.repository and self.commit.startswith(commit)
        return name == self.repository or (len(name) >= 7 and self.commit.startswith(name))


def stored_snapshots() -> list[Stored]:
    """Everything in the store, the latest used first. Nothing is verified."""
    from envhub_sandbox.hub import store

    folder = store.cache_root() / "snapshots"
    records = [*folder.glob("local/*/record.json"), *folder.glob("*/*/*/record.json")]
    found = [_read(record) for record in records]
    return sorted((one for one in found if one is not None), key=lambda one: -one.used)


def _read(record: Path) -> Stored | None:
    try:
        document = json_module.loads(record.read_bytes())
        size = sum(row[1] for row in document["files"])
        used = record.stat().st_mtime
    except (OSError, ValueError, LookupError, TypeError):
        return None
    home = record.parent
    revision = document.get("revision")
    return Stored(_repository(home.parent.name), home.name, revision, used, size, home)


def _repository(name: str) -> str:
    kind, *parts = name.split("--")
    prefix = {"space": "spaces/", "dataset": "datasets/"}.get(kind, "")
    return prefix + "/".join(parts) if parts else name


@app.command("list")
def list_(
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List snapshots, the latest used first."""
    from envhub_sandbox.hub import store

    with reported(debug=False):
        found = stored_snapshots()
        if json:
            print_json({"folder": str(store.cache_root()), "snapshots": _data(found)})
            return
        if found:
            _print(found)
        total = sum(one.size for one in found)
        say(f"{len(found)} snapshots, {_size(total)}, in {store.cache_root()}")


def _data(found: list[Stored]) -> list[dict[str, Any]]:
    return [
        {
            "repository": one.repository,
            "commit": one.commit,
            "revision": one.revision,
            "last_used": time.strftime("%FT%TZ", time.gmtime(one.used)),
            "bytes": one.size,
        }
        for one in found
    ]


def _print(found: list[Stored]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for title in ("repository", "commit", "revision", "last used"):
        table.add_column(title, overflow="fold")
    table.add_column("size", justify="right")
    for one in found:
        used = time.strftime("%F", time.localtime(one.used))
        revision = safe_line(one.revision or "", 40)
        table.add_row(safe_line(one.repository), one.commit, revision, used, _size(one.size))
    console().print(table)


def _size(count: float) -> str:
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"


@app.command("remove", no_args_is_help=True)
def remove(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME]...",
            help="A repository, a commit (at least 7 characters of it), or repository@commit.",
        ),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Everything, remembered descriptions included.")
    ] = False,
    unused_for: Annotated[
        float | None, typer.Option(metavar="DAYS", min=0, help="What nobody used for so long.")
    ] = None,
) -> None:
    """Remove snapshots. Not while an environment of theirs runs."""
    from envhub_sandbox.hub import store

    with reported(debug=False):
        found = stored_snapshots()
        if everything:
            chosen = found
            shutil.rmtree(store.cache_root() / "manifests", ignore_errors=True)
        else:
            chosen = _chosen(found, names or [], unused_for)
        for one in chosen:
            store.remove_tree(one.home)
        say(f"Removed {len(chosen)} snapshots, {_size(sum(one.size for one in chosen))}.")


def _chosen(found: list[Stored], names: list[str], unused_for: float | None) -> list[Stored]:
    for name in names:
        if not any(one.answers_to(name) for one in found):
            raise UsageError(f"nothing in the store is called {name!r}; see: envhub cache list")
    chosen = [one for one in found if any(one.answers_to(name) for name in names)]
    if unused_for is not None:
        oldest = time.time() - unused_for * _DAY_S
        pool = chosen if names else found
        chosen = [one for one in pool if one.used < oldest]
    return chosen
