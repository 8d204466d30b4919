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
        *("envhub_sandbox.check", "envhub_sandbox.cli.check", "envhub_sandbox.cli.diff"),
        "envhub_sandbox.cli.shared.findings",
    },
    "crash": {"envhub_sandbox.cli.replay", "envhub_sandbox.session.crash"},
    "denials": {"envhub_worker.lockdown.seccomp.evidence"},
    "docker": {"envhub_sandbox.cli.image", "envhub_sandbox.sandboxes.docker"},
    "fleet": {"envhub_sandbox.sandboxes.fleet"},
    "libraries": {"envhub_sandbox.integrations"},
    "old gym": {"envhub_worker.runner.old_gym"},
    "packages": {
        *("envhub_sandbox.cli.download", "envhub_sandbox.cli.lock", "envhub_sandbox.dependencies")
    },
    "ray": {"envhub_sandbox.sandboxes.ray"},
    "remote": {
        "envhub_sandbox.cli.doctor_server",
        *(f"envhub_sandbox.sandboxes.{name}" for name in ("remote", "remote_keys")),
        *("envhub_sandbox.sandboxes.remote_repository", "envhub_sandbox.transport.tcp"),
        "envhub_worker.access",
        *(f"envhub_worker.cli.{name}" for name in ("drain", "health", "http_port", "identity")),
        *(f"envhub_worker.cli.{name}" for name in ("keygen", "listen", "listen_options")),
        *(f"envhub_worker.cli.{name}" for name in ("metrics", "state_folder", "status")),
    },
    "sources": {  # of snapshots, beside the Hub and folders
        *("envhub_sandbox.hub.git.address", "envhub_sandbox.hub.git.commits"),
        "envhub_sandbox.hub.registered",
        "envhub_sandbox.hub.sources.assets",
    },
}
# What lies in the folder of an extra, and is core: ``envhub run`` plays, and prints what confines;
# every server has a gate, be it open, and sessions.
CORE = {
    *(f"envhub_sandbox.check.play.{name}" for name in ("confinement", "episodes", "plays")),
    *(f"envhub_worker.access.{name}" for name in ("gate", "sessions")),
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
