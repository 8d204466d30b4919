"""``envhub inspect --download``: all that an environment needs, for use without network."""

from __future__ import annotations

from typing import TYPE_CHECKING

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import ProgressBar, out, print_json, safe_line, show
from envhub_worker.protocol.text import size_text

if TYPE_CHECKING:
    from envhub_sandbox.extras.packages.environments import Environment
    from envhub_sandbox.hub.snapshot import Snapshot


def download(make: opt.MakeOptions, *, upgrade: bool, as_json: bool) -> None:
    """Download a repository and install its packages, without running the repository."""
    with ProgressBar(quiet=as_json) as bar:
        bar.begin(f"reading {make.ref}")
        snapshot = make.snapshot_with_assets(make.ref)
        environment = _environment(snapshot, make, upgrade)
    if as_json:
        installed = environment and {
            "folder": str(environment.home),
            "python": environment.python,
            "version": environment.version,
            "bytes": environment.size,
            **environment.facts,
        }
        print_json(
            {"reference": snapshot.reference, "commit": snapshot.commit, "environment": installed}
        )
    else:
        _print(snapshot, environment)


def _environment(snapshot: Snapshot, make: opt.MakeOptions, upgrade: bool) -> Environment | None:
    from envhub_sandbox.extras.packages import packages
    from envhub_sandbox.extras.packages.request import chosen

    dependencies, lock = make["dependencies"], make["lock"]
    if lock is not None:
        opened = packages.opened_lock(lock, "process", None, dependencies)
        return packages.locked_packages(snapshot, opened).environment
    target = packages.ThisMachine(upgrade=upgrade)
    package_set = packages.packages_for(snapshot, chosen(dependencies, None)[0], target)
    return None if package_set is None else package_set.environment


def _print(snapshot: Snapshot, environment: Environment | None) -> None:
    out(safe_line(snapshot.reference, 300))
    if environment is None:
        show("packages", "this interpreter's, which are enough", stderr=True)
        return
    count, size = len(environment.pins), size_text(environment.size)
    show("packages", f"{count}, {size}, for Python {environment.version}", stderr=True)
    show("in", environment.home, stderr=True)
