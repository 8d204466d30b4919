"""The core imports no extra, and an extra few others.

The core is what a newcomer reads: processes as the sandbox, the Hub and folders, both lanes,
Gymnasium's interface, the confinement. Each extra is a feature that the core could do without.
"""

from __future__ import annotations

from collections.abc import Iterator
from graphlib import TopologicalSorter

from tests.unit.docs.test_imports import below, imported, modules

# Each extra, and the packages and modules of it. Whatever is named in none of them is core.
EXTRAS = {
    "check": {
        *(
            "envhub_sandbox.extras.judge",
            "envhub_sandbox.extras.judge.command",
            "envhub_sandbox.extras.judge.command.diff",
        ),
        "envhub_sandbox.extras.judge.command.findings",
    },
    "crash": {"envhub_sandbox.extras.crash.command", "envhub_sandbox.extras.crash"},
    "denials": {"envhub_worker.extras.denials"},
    "docker": {"envhub_sandbox.extras.docker.command", "envhub_sandbox.extras.docker"},
    "fleet": {"envhub_sandbox.extras.fleet"},
    "libraries": {"envhub_sandbox.integrations"},
    "old gym": {"envhub_worker.extras.old_gym"},
    "packages": {
        *(
            "envhub_sandbox.extras.packages.commands.download",
            "envhub_sandbox.extras.packages.commands.lock",
            "envhub_sandbox.extras.packages",
        )
    },
    "ray": {"envhub_sandbox.extras.ray"},
    "remote": {
        "envhub_sandbox.extras.remote.doctor",
        *(f"envhub_sandbox.sandboxes.{name}" for name in ("remote", "remote_keys")),
        *("envhub_sandbox.extras.remote.repository", "envhub_sandbox.extras.remote.tcp"),
        "envhub_worker.extras.access",
        *(
            f"envhub_worker.extras.access.commands.{name}"
            for name in ("drain", "health", "http_port", "identity")
        ),
        *(
            f"envhub_worker.extras.access.commands.{name}"
            for name in ("keygen", "listen", "listen_options")
        ),
        *(
            f"envhub_worker.extras.access.commands.{name}"
            for name in ("metrics", "state_folder", "status")
        ),
    },
    "sources": {  # of snapshots, beside the Hub and folders
        *("envhub_sandbox.extras.sources.git_address", "envhub_sandbox.extras.sources.git_commits"),
        "envhub_sandbox.extras.sources.registered",
        "envhub_sandbox.extras.sources.assets",
    },
}
# What lies in the folder of an extra, and is core: ``envhub run`` plays, and prints what confines;
# every server has a gate, be it open, and sessions.
CORE = {
    *(f"envhub_sandbox.extras.judge.play.{name}" for name in ("confinement", "episodes", "plays")),
    *(f"envhub_worker.extras.access.{name}" for name in ("gate", "sessions")),
}
# The extras that an extra may import.
EXTRAS_OF_EXTRAS = {
    "check": {"packages"},
    "docker": {"packages", "remote"},
    "fleet": {"packages", "remote"},
    "packages": {"sources"},
    "ray": {"packages", "remote"},
    "remote": {"packages"},
}


def extra_of(module: str) -> str | None:
    """The extra that a module belongs to; None of the core."""
    for extra, parts in EXTRAS.items():
        if module not in CORE and any(below(module, part) for part in parts):
            return extra
    return None


def imports_of_extras() -> Iterator[tuple[str, str]]:
    """What imports a module of an extra that is not its own, and that module.

    Without the package's public names: it finds these when they are used.
    """
    for name in modules().keys() - {"envhub_sandbox"}:
        for target in imported(name) & modules().keys():
            if extra_of(target) not in (None, extra_of(name)):
                yield name, target


def test_the_core_imports_no_extra() -> None:
    """It finds one by its name, and does without or says what is missing."""
    assert [pair for pair in imports_of_extras() if extra_of(pair[0]) is None] == []


def test_an_extra_imports_few_others() -> None:
    found: dict[str, set[str]] = {}
    for name, target in imports_of_extras():
        if (extra := extra_of(name)) is not None:
            found.setdefault(extra, set()).add(str(extra_of(target)))
    assert found == EXTRAS_OF_EXTRAS
    TopologicalSorter(found).prepare()  # raises CycleError


def test_what_belongs_to_an_extra_exists() -> None:
    """A name that is gone would leave its successor in the core."""
    assert {part for parts in EXTRAS.values() for part in parts} <= modules().keys()
