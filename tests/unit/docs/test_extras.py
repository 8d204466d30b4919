"""The core imports no extra, but for what the list still permits, and an extra few others.

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
    "denials": {f"envhub_worker.lockdown.seccomp.{name}" for name in ("evidence", "notify")},
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
    "served steps": {
        "envhub_sandbox.transport.shared_memory.served_lane",
        "envhub_worker.supervisor.served_slabs",
    },
    "sources": {  # of snapshots, beside the Hub and folders
        *("envhub_sandbox.hub.git.address", "envhub_sandbox.hub.git.commits"),
        "envhub_sandbox.hub.registered",
        "envhub_sandbox.hub.sources.assets",
    },
}
# What lies in the folder of an extra, and is core: ``envhub run`` plays, and prints what confines.
CORE = {f"envhub_sandbox.check.play.{name}" for name in ("confinement", "episodes", "plays")}
# The extras that an extra may import.
EXTRAS_OF_EXTRAS = {
    "check": {"packages"},
    "docker": {"packages", "remote"},
    "fleet": {"packages", "remote"},
    "packages": {"sources"},
    "ray": {"packages", "remote"},
    "remote": {"packages"},
}
# What modules of the core import of extras today, in the same package: this list only gets shorter.
CORE_IMPORTS_EXTRAS = {
    "envhub_worker.__main__": {"cli.drain", "cli.health", "cli.keygen", "cli.listen", "cli.status"},
    "envhub_worker.runner.recording": {"runner.old_gym"},
    "envhub_worker.runner.sync_envs": {"runner.old_gym"},
    "envhub_worker.runner.tasks": {"runner.old_gym"},
    "envhub_worker.server": {"access.gate", "access.sessions"},
    "envhub_worker.spawn.jail_init": {"lockdown.seccomp.evidence", "lockdown.seccomp.notify"},
    "envhub_worker.supervisor.jail_events": {"supervisor.served_slabs"},
    "envhub_worker.supervisor.jails": {"supervisor.served_slabs"},
    "envhub_worker.supervisor.runner_stream": {"supervisor.served_slabs"},
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


def test_the_core_imports_no_further_extra() -> None:
    """A new import of an extra is refused, and one that is gone leaves the list."""
    found: dict[str, set[str]] = {}
    for name, target in imports_of_extras():
        if extra_of(name) is None:
            found.setdefault(name, set()).add(target.partition(".")[2])
    assert found == CORE_IMPORTS_EXTRAS


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
