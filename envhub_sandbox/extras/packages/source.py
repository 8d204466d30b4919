"""Implements the packages of a repository for ``make_env``: see ``factory.package_source``."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.extras.packages.modules import MissingModule, note_missing
from envhub_sandbox.extras.packages.packages import (
    PackageSet,
    PackageTarget,
    ThisMachine,
    check_locked_tasks,
    locked_packages,
    opened_lock,
    packages_for,
)
from envhub_sandbox.extras.packages.request import Choice, chosen, request_of
from envhub_sandbox.hub.snapshot import Snapshot

if TYPE_CHECKING:
    from envhub_sandbox.extras.packages.locks.lockfile import LockFile
    from envhub_worker.protocol.manifest.manifest import Manifest


@dataclass(frozen=True)
class RepositoryPackages:
    """Makes the packages that a repository declares and imports, or those of a lock."""

    choice: Choice
    python: str | Path | None
    lock: LockFile | None

    @classmethod
    def of(
        cls,
        lock: str | os.PathLike[str] | None,
        sandbox: object,
        python: str | Path | None,
        dependencies: str | os.PathLike[str] | Mapping[str, Any],
    ) -> RepositoryPackages:
        """Reads the arguments of ``make_env``. Raises ``PolicyError``, ``LockError``."""
        opened = None if lock is None else opened_lock(lock, sandbox, python, dependencies)
        return cls(*chosen(dependencies, python), opened)

    @property
    def assets(self) -> Sequence[str]:
        """Returns the further repositories that the lock names."""
        return self.lock.assets if self.lock is not None else ()

    @property
    def always(self) -> bool:
        """Tells whether the repository gets its own packages even if the place meets everything."""
        return self.choice.where == "own"

    def packages(
        self, snapshot: Snapshot, target: PackageTarget | None, *, gpu: bool
    ) -> PackageSet | None:
        """Makes its own packages for a place; None if it uses the place's packages."""
        if self.lock is not None:
            return locked_packages(snapshot, self.lock)
        return None if target is None else packages_for(snapshot, self.choice, target, gpu=gpu)

    def advice(self, snapshot: Snapshot, place: str, own: bool, text: str) -> str:
        """Returns advice for a missing module, for the error's text."""
        return MissingModule(snapshot, place, self.choice.where, self.python, own).advice(text)

    def note(self, snapshot: Snapshot, target: PackageTarget | None, text: str) -> bool:
        """Note a missing module; tells whether ``packages`` now gives different packages."""
        return self.choice.infer and self._chooses(target) and note_missing(snapshot, text)

    def _chooses(self, target: PackageTarget | None) -> bool:
        """Tells whether we choose the versions of its packages."""
        return self.lock is None and target is not None and self.choice.where != "host"

    def of_its_day(
        self, snapshot: Snapshot, target: PackageTarget | None, error: EnvHubError
    ) -> str:
        """Returns advice for an error that older packages may cure; empty for other errors."""
        of_today = self._chooses(target) and self.choice.exclude_newer is None
        if not of_today:
            return ""
        from envhub_sandbox.extras.packages.locks import day

        if not isinstance(target, ThisMachine):
            return day.of_its_day(snapshot, error)  # only it knows its index and interpreters
        return day.of_its_day(snapshot, error, partial(self._resolves, snapshot))

    def _resolves(self, snapshot: Snapshot, keys: Mapping[str, Any]) -> bool:
        """Tells whether there are versions with further keys of ``dependencies``."""
        from envhub_sandbox.extras.packages.resolution import resolutions

        further, old = chosen(keys, None)[0], self.choice
        choice = replace(
            further,
            extra=(*old.extra, *further.extra),
            only=old.only,
            without=old.without,
            override=(*further.override, *old.override),
            python=further.python or old.python,
        )
        request = request_of(snapshot, choice)
        return request is not None and resolutions.has_versions(request)

    def check(
        self, manifest: Manifest, label: str, env_kwargs: Mapping[str, Any], config: object
    ) -> None:
        """Raise ``LockDriftError`` if a manifest differs from the lock."""
        if self.lock is not None and config is None:
            check_locked_tasks(manifest, self.lock, label, env_kwargs)
