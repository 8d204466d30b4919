"""Where a repository's packages come from: of the core, the interpreter that its jails run on.

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
    """Makes no packages.

    Attributes:
        python: The interpreter that the caller named.
        assets: The further repositories that a lock names.
        always: Whether the repository gets packages of its own, whatever the place has.
    """

    assets: Sequence[str] = ()
    always = False

    def __init__(self, python: str | Path | None) -> None:
        self.python = python

    def packages(self, snapshot: Snapshot, target: Any, *, gpu: bool) -> Any:
        """Packages of the repository's own, made for a place; None for those of the place."""

    def advice(self, snapshot: Snapshot, place: str, own: bool, text: str) -> str:
        """What to do where a module is missing, for the error's text."""
        return "Install it into the interpreter that runs the environment"

    def note(self, snapshot: Snapshot, target: Any, text: str) -> bool:
        """Note a module that was missing; whether ``packages`` gives others now."""
        return False

    def of_its_day(self, snapshot: Snapshot, target: Any, error: EnvHubError) -> str:
        """What to do about an error that older packages may cure; empty for others."""
        return ""

    def check(
        self, manifest: Manifest, label: str, env_kwargs: Mapping[str, Any], config: object
    ) -> None:
        """Raise where a manifest is not what was locked."""


def source_of(options: Options) -> PackageSource:
    """The source that arguments of ``make_env`` choose. Raises ``PolicyError``: none is so."""
    choice = options.lock, options.sandbox, options.python, options.dependencies
    extra = extras.find(_EXTRA, "RepositoryPackages")
    if extra is None:
        if options.lock is not None:
            extras.required(_EXTRA, "RepositoryPackages", option_name("lock"))
        if options.dependencies not in ("auto", "host"):
            extras.required(_EXTRA, "RepositoryPackages", option_name("dependencies"))
        return PackageSource(options.python)
    return cast("PackageSource", extra.of(*choice))
