"""Where a repository's packages come from: in the core, the interpreter of its jails.

The extra ``extras.packages.source`` makes packages for a repository.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.settings.options import Options, option_name
from envhub_sandbox.system import extras
from envhub_worker.protocol.manifest.manifest import Manifest

_EXTRA = "envhub_sandbox.extras.packages.source"


class PackageSource:
    """Makes no packages: the repository uses those of the interpreter.

    Attributes:
        python: The interpreter that the caller named, or None.
        assets: The further repositories that a lock names.
        always: Whether the repository gets its own packages even if the interpreter has them.
    """

    assets: Sequence[str] = ()
    always = False

    def __init__(self, python: str | Path | None) -> None:
        self.python = python

    def packages(self, snapshot: Snapshot, target: Any, *, gpu: bool) -> Any:
        """The repository's own packages, made for a target; None to use the interpreter's."""

    def advice(self, snapshot: Snapshot, place: str, own: bool, text: str) -> str:
        """Advice about a missing module, for the error's text."""
        return "Install it into the interpreter that runs the environment"

    def note(self, snapshot: Snapshot, target: Any, text: str) -> bool:
        """Note a missing module; returns whether ``packages`` now returns other packages."""
        return False

    def of_its_day(self, snapshot: Snapshot, target: Any, error: EnvHubError) -> str:
        """Advice about an error that older packages may cure; empty for other errors."""
        return ""

    def check(
        self, manifest: Manifest, label: str, env_kwargs: Mapping[str, Any], config: object
    ) -> None:
        """Raise if a manifest differs from the lock."""


def source_of(options: Options) -> PackageSource:
    """The source for the arguments of ``make_env``. Raises ``PolicyError``: they are invalid."""
    choice = options.lock, options.sandbox, options.python, options.dependencies
    extra = extras.find(_EXTRA, "RepositoryPackages")
    if extra is None:
        if options.lock is not None:
            extras.required(_EXTRA, "RepositoryPackages", option_name("lock"))
        if options.dependencies not in ("auto", "host"):
            extras.required(_EXTRA, "RepositoryPackages", option_name("dependencies"))
        return PackageSource(options.python)
    return cast("PackageSource", extra.of(*choice))
