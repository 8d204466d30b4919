"""Finds leftovers of killed clients: containers, folders, control groups.

It finds only objects that are certainly ours and no longer in use. A live process holds a lock: a
client that of its folder, which a label of its container names, and a server those of its folders
and control groups. Objects without such a lock are left alone, and so are another user's, whose
files we may not even see; root sees all, and removes every user's containers and control groups.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from envhub_sandbox.errors import SandboxUnavailableError
from envhub_sandbox.extras.docker.engines import (
    ENGINES,
    Engine,
    EngineError,
    find_engine,
    is_elsewhere,
)
from envhub_sandbox.extras.docker.run_arguments import FOLDER_LABEL, USER_LABEL
from envhub_sandbox.sandboxes.process import is_in_use, places, stale_folders
from envhub_sandbox.system.locks import is_held, unheld
from envhub_sandbox.system.platform import user_id

_CGROUPS = Path("/sys/fs/cgroup")
_ENDED = frozenset({"exited", "stopped", "dead"})
_GROUP = re.compile(r"envhub_\d+_\w[\w-]*")


@dataclass(frozen=True)
class Leftover:
    """One thing that is not in use any more.
    ``kind``: ``"container"``, ``"folder"`` or ``"control group"``.
    ``name``: a container's name, or a path.
    """

    kind: str
    name: str
    engine: Engine | None = None

    def remove(self) -> bool:
        """Remove the leftover; returns whether it is gone."""
        if self.engine is not None:
            with contextlib.suppress(EngineError):
                self.engine.run("rm", "--force", "--volumes", self.name)
                return True
            return False
        if self.kind == "folder":
            shutil.rmtree(self.name, ignore_errors=True)
            return not os.path.exists(self.name)
        folder = Path(self.name)
        # a server that has just made it takes the lock next, and makes another if it is gone
        with contextlib.suppress(OSError), unheld(folder) as free:
            for inner in [path for path in folder.iterdir() if free and path.is_dir()]:
                inner.rmdir()
            if free:
                folder.rmdir()
        return not folder.exists()


class Found(NamedTuple):
    """The result of a search.
    ``leftovers``: the objects that can be removed.
    ``unasked``: the installed engines that did not answer, with the reason.
    """

    leftovers: list[Leftover]
    unasked: dict[str, str]


def find() -> Found:
    """Searches for all kinds of leftovers. Removes nothing."""
    containers, unasked = _containers()
    folders = [
        Leftover("folder", str(path))
        for folder_root in places()
        for path in stale_folders(folder_root)
    ]
    return Found([*containers, *folders, *stale_groups(_CGROUPS)], unasked)


def _containers() -> tuple[list[Leftover], dict[str, str]]:
    """Those of every engine that answers, and why others do not; a machine need not have any."""
    by_engine: dict[str, list[Leftover]] = {}
    unasked = {}
    for name in ENGINES:
        try:
            engine = find_engine(name)
            if engine.kind not in by_engine:
                by_engine[engine.kind] = list(stale_containers(engine))
        except (SandboxUnavailableError, EngineError) as error:
            if shutil.which(name) and not is_elsewhere(name):
                unasked[name] = str(error)
    return [leftover for leftovers in by_engine.values() for leftover in leftovers], unasked


def stale_containers(engine: Engine) -> Iterator[Leftover]:
    """Containers of ours whose client has ended, running or not.

    One that runs for a client of another machine, whose folder is not here, is left alone.
    """
    listed = engine.run(
        "ps", "--all", "--no-trunc", "--filter", f"label={FOLDER_LABEL}", "--format", "{{.ID}}"
    )
    for container in listed.split():
        with contextlib.suppress(EngineError, ValueError):  # it may have gone meanwhile
            description = json.loads(engine.run("inspect", container))[0]
            labels = description["Config"]["Labels"]
            is_ours = user_id() == 0 or labels.get(USER_LABEL) == str(user_id())
            if is_ours and _is_deserted_container(description):
                yield Leftover("container", description["Name"].lstrip("/"), engine)


def _is_deserted_container(description: dict[str, Any]) -> bool:
    folder = Path(description["Config"]["Labels"][FOLDER_LABEL])
    try:
        return not is_in_use(folder)
    except FileNotFoundError:
        # an engine may be another machine's: its clients run there, or on a third one
        return description["State"]["Status"] in _ENDED
    except OSError:
        return False


def stale_groups(root: Path) -> Iterator[Leftover]:
    """Control groups of servers that have ended; the kernel keeps those with processes in them."""
    folders = {path for level in ("", "*/", "*/*/") for path in root.glob(f"{level}envhub_*")}
    for folder in sorted(folders):
        with contextlib.suppress(OSError):
            processes = folder / "cgroup.procs"
            used = processes.exists() and processes.read_text()
            ours = _GROUP.fullmatch(folder.name) and os.access(folder, os.W_OK)
            if ours and not used and not is_held(folder):
                yield Leftover("control group", str(folder))
