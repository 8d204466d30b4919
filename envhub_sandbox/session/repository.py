"""One repository under one policy: the state that its environments share, and errors of its start.

``provenance_of`` describes what ran. A pickle of a proxy contains a ``Recipe``, the arguments that
made it; unpickling makes a new environment of the same commit in a worker of its own. The recipe
never contains a token or a login: the process that unpickles it uses its own. ``plain_config``
converts a caller's config object to plain data.
"""

from __future__ import annotations

import inspect
import os
import shlex
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import field, fields, is_dataclass
from enum import Enum
from itertools import count
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

from envhub_sandbox.errors import (
    DependencyError,
    EnvHubError,
    WorkerDiedError,
    WorkerTimeoutError,
    name_source,
)
from envhub_sandbox.hub.client import default_endpoint
from envhub_sandbox.hub.logins import without_login
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.session.error_text import add_author_line, add_reach_advice, why_missing
from envhub_sandbox.session.recorder import Crash, Recorder, recorder_for
from envhub_sandbox.settings.options import Options, option_name
from envhub_sandbox.settings.policy import Limits, Policy, Timeouts
from envhub_sandbox.system.folders import cache_root
from envhub_sandbox.system.locks import SharedLock
from envhub_sandbox.system.log import CRASHES
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.remote_warnings import RemoteWarnings
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import LACKS_PACKAGES
from envhub_worker.protocol.limits import WireLimits, limits_for
from envhub_worker.protocol.manifest.manifest import Manifest
from envhub_worker.protocol.messages import CONFIG_CLASS, VERSION
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.runtime import RECORD, Runtime
from envhub_worker.protocol.text import printable

_PLAIN = (type(None), bool, int, float, complex, str, bytes, np.ndarray, np.generic)
_MAX_DEPTH = 16
_LEFT_OUT = object()
ENV_ID = "Hub-v0"
"""The id of all our environments for Gymnasium."""
_MAKERS = "envhub_sandbox.integrations.gym"
_SPEC_FACTS = frozenset({"max_episode_steps", "reward_threshold", "nondeterministic"})
"""The facts of a repository's spec that also hold in a sandbox."""


@dataclass(frozen=True)
class PlainConfig:
    """The plain data of a caller's config object; ``make_env`` takes it like the object."""

    hub_path: str
    values: dict[str, object]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """The arguments of ``make_env``, with the commit pinned.

    Attributes:
        make_env: The function to call; a pickle contains only its name.
        reference: The pinned hub reference, or a local folder and its entry file.
        config: The caller's config object as plain values, or None.
    """

    make_env: Callable[..., Any]
    reference: str
    config: dict[str, object] | None = field(repr=False)
    options: dict[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        endpoint = self.options.get("endpoint")
        if isinstance(endpoint, str):
            plain = {**self.options, "endpoint": without_login(endpoint)}
            object.__setattr__(self, "options", plain)

    def make(self) -> Any:
        """Make new environments; returns and raises as ``make_env``."""
        return self.make_env(self._cfg, **self._options)

    def make_one(self, suite: str, task: int | str) -> Any:
        """Make new environments, and return one of them."""
        return self.make()[suite][task]

    def spec(self, suite: str, task: int | str, facts: Mapping[str, Any] | None) -> EnvSpec:
        """A spec from which ``gym.make`` makes this environment again, in a sandbox.
        ``facts``: the fields of the repository's own spec. Trust: input from the worker; none of
        its fields that say how to make an environment is used.
        """
        safe_facts = {name: value for name, value in (facts or {}).items() if name in _SPEC_FACTS}
        if (safe_facts.get("max_episode_steps") or 0) < 1:
            safe_facts["max_episode_steps"] = None
        return EnvSpec(
            ENV_ID,
            entry_point=f"{_MAKERS}:make_again",
            vector_entry_point=f"{_MAKERS}:make_vector",
            kwargs={"ref": self._cfg, "suite": suite, "task": task, **self.differing},
            **{**safe_facts, "nondeterministic": bool(safe_facts.get("nondeterministic"))},
        )

    @property
    def _cfg(self) -> Any:
        if self.config is None:
            return self.reference
        return PlainConfig(self.reference, {**self.config, "hub_path": self.reference})

    @property
    def _options(self) -> dict[str, Any]:
        options = dict(self.options)
        if options.get("endpoint") == without_login(default_endpoint()):
            options["endpoint"] = None  # the default may have a login here
        return options

    @property
    def differing(self) -> dict[str, Any]:
        """The options that differ from their defaults, as values for JSON where possible."""
        default = Options()
        return {
            name: plain
            for name, value in self._options.items()
            if name != "n_envs" and value != getattr(default, name)
            if (plain := _differences(value)) not in (None, {}, ())
        }


def provenance_of(
    snapshot: Snapshot,
    manifest: Manifest | None,
    report: list[dict[str, Any]],
    installed: dict[str, Any] | None = None,
    profile: str | None = None,
    places: Sequence[str] = (),
) -> dict[str, Any]:
    """Describes a run as plain data: enough to repeat it, or to see why it cannot be repeated.
    ``report``: the layers of confinement. Trust: the worker says which interpreter and packages.
    """
    return {
        "repository": snapshot.repo_id,
        "repo_type": snapshot.repo_type,
        "commit": snapshot.commit,
        "path": snapshot.path,
        "files": {record.path: record.digest for record in snapshot.files},
        "interpreter": dict(manifest.interpreter) if manifest else None,
        "packages": dict(manifest.packages) if manifest else None,
        "assets": [asset.pinned for asset in snapshot.assets],
        "installed": installed,
        "protocol": VERSION,
        "profile": profile,
        "places": list(places),
        "layers": [dict(layer) for layer in report],
    }


def _differences(value: Any) -> Any:
    """The non-default fields of a policy, timeouts or limits; any other value unchanged."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if not isinstance(value, (Policy, Timeouts, Limits)):
        return value
    default = type(value)()
    each = {item.name: getattr(value, item.name) for item in fields(value)}
    return {
        name: _differences(field_value)
        for name, field_value in each.items()
        if field_value != getattr(default, name)
    }


def _no_advice(subject: object) -> str:
    return ""


class Repository:
    """The state that the environments of one ``make_env`` share. ``Launcher`` opens its jails.

    Args:
        arguments: The arguments for the repository's ``make_env``.
        runtime: The interpreter and the packages of the jails.
        copy: Whether observations are copied for the caller, or lent.
        installed: The packages that were installed for it, for the provenance.
        advice: Returns advice about a missing module, for the error's text.
        of_its_day: Returns advice if today's packages may be at fault; empty for other errors.

    Attributes:
        label: Repository, commit and entry file, for errors.
        wire_limits: Bounds on a jail's messages.
        warnings: The warnings of the repository in all jails.
        latest_report, latest_profile: The layers and the profile of the jail that was opened last.
        places: The address where each worker runs or will run.
        jail_numbers: Counts the jails, to name the files of their output.
        for_lerobot: Whether LeRobot's programs use it: see ``serve_lerobot``.
    """

    def __init__(
        self,
        snapshot: Snapshot,
        arguments: m.Load,
        policy: Policy,
        timeouts: Timeouts,
        runtime: Runtime,
        copy: bool,
        *,
        min_ready: int | None = None,
        recipe: Recipe,
        installed: dict[str, Any] | None,
        advice: Callable[[str], str] = _no_advice,
        of_its_day: Callable[[EnvHubError], str] = _no_advice,
    ) -> None:
        self.snapshot = snapshot
        self.arguments = arguments
        self.policy = policy
        self.label = snapshot.label
        self.wire_limits: WireLimits = limits_for(policy.limits.message_bytes)
        self.timeouts = timeouts
        self.runtime = runtime
        self._in_use: list[SharedLock] = []  # on snapshots and packages, against their removal
        self._holders: set[object] = set()  # launchers with a live environment
        self._lock_files()
        self.copy = copy
        self.min_ready = min_ready
        self.warnings = RemoteWarnings()
        self.jail_numbers = count(1)
        self.latest_report: list[dict[str, Any]] = []
        self.latest_profile: str | None = None
        self.places: list[str] = []
        self.for_lerobot = False
        self.recipe = recipe
        self.installed = installed
        self._advice = advice
        self._of_its_day = of_its_day

    def hold(self, holder: object) -> None:
        """Lock the files and packages against removal until each holder has called ``let_go``."""
        self._holders.add(holder)
        self._lock_files()

    def _lock_files(self) -> None:
        if self._in_use:
            return
        folders = [snapshot.root.parent for snapshot in (self.snapshot, *self.snapshot.assets)]
        if os.path.isabs(self.runtime.packages):  # else a name on another host
            folders.append(Path(self.runtime.packages).with_name(RECORD))
        self._in_use = [SharedLock(folder) for folder in folders]

    def let_go(self, holder: object) -> None:
        """Release the locks after the last holder. Idempotent, even after an interrupt."""
        self._holders.discard(holder)
        if self._holders:
            return
        for lock in self._in_use:
            lock.release()
        self._in_use = []

    @contextmanager
    def named(self) -> Iterator[None]:
        """Add the repository's name, advice and the author's line to errors of this project."""
        # The order matters: ``add_author_line`` sets ``__notes__``, by which the other steps see
        # that an error has passed here before, so it comes last.
        try:
            yield
        except EnvHubError as error:
            advice = "" if "__notes__" in vars(error) else why_missing(error, self.snapshot)
            if isinstance(error, DependencyError) and not str(error).startswith(self.label):
                error.args = (f"{error}. {advice or self._advice(str(error))}",)
            elif isinstance(error, ModuleNotFoundError) and "__notes__" not in vars(error):
                error.args = (f"{error.args[0]}\n{advice or self._advice(str(error))}",)
            elif advice and advice not in str(error):
                error.args = (f"{error.args[0]}\n{advice}", *error.args[1:])
            name_source(error, self.label)
            is_explained = add_reach_advice(error, self.policy) or "__notes__" in vars(error)
            if not is_explained and (dated := self._of_its_day(error)):
                error.args = (f"{error.args[0]}\n{dated}", *error.args[1:])
            add_author_line(error, self.snapshot)
            raise

    def provenance(
        self, manifest: Manifest | None, report: list[dict[str, Any]] | None = None
    ) -> dict[str, Any]:
        """``provenance_of`` this run; ``report``: None for the layers of the latest jail."""
        layers = self.latest_report if report is None else report
        run = self.installed, self.latest_profile, self.places
        return provenance_of(self.snapshot, manifest, layers, *run)

    @contextmanager
    def starting(self, deadline: Deadline) -> Iterator[None]:
        """Turn a timeout or death during the start into the caller's error, with a crash bundle."""
        try:
            yield
        except WorkerDiedError as error:
            if error.reason == "zygote" and error.exit_code == LACKS_PACKAGES:
                missing = error.detail.strip().removeprefix("ModuleNotFoundError: ")
                raise DependencyError(f"{self.label}: {printable(missing)}") from error
            if not deadline.unasked:
                self.keep_crash(error)
            raise
        except WorkerTimeoutError as error:
            if error.request is not None or deadline.unasked:
                raise
            startup_s = self.timeouts.startup_s
            late = WorkerTimeoutError(
                f"make_env has not finished after {startup_s} s and was ended; raise "
                f"{option_name('startup_s', 2 * (startup_s or 1))}, or make it again",
                request="make_env",
                timeout_s=startup_s,
            )
            late.denied = error.denied
            self.keep_crash(late)
            raise late from error

    def keep_crash(
        self,
        error: WorkerDiedError | WorkerTimeoutError,
        recorder: Recorder | None = None,
        task: dict[str, Any] | None = None,
        manifest: Manifest | None = None,
        report: list[dict[str, Any]] | None = None,
    ) -> None:
        """Write a crash bundle and name it in the error. Failing to write it is only logged.

        Arguments other than ``error`` are None before there is a jail.
        """
        ended = getattr(error, "reason", "") in ("killed", "idle", "gone", "connection")
        if ended or not self.policy.crash_history or error.bundle is not None:
            return
        crash = Crash(
            error=error,
            label=self.label,
            provenance=self.provenance(manifest, report),
            load=self.arguments,
            options=self.recipe.differing,
            task=task,
        )
        folder = Path(self.policy.crash_folder or cache_root() / "crashes").absolute()
        try:
            bundle = (recorder or recorder_for(self.policy.crash_history)).write(folder, crash)
        except Exception as problem:
            CRASHES.warning("%s: no crash bundle could be written: %s", self.label, problem)
            return
        if bundle is None:
            return
        error.bundle = str(bundle)
        # a bundle outside of the cache may be a stranger's: replay needs --grant
        options = " --grant" if self.policy.crash_folder else ""
        again = f"To try the same again: envhub replay {shlex.quote(error.bundle)}{options}"
        error.args = (f"{error.args[0]}\n{again}", *error.args[1:])
        CRASHES.info("%s: crash bundle %s", self.label, bundle)


# --- a caller's config object


def plain_config(config: Any) -> dict[str, object]:
    """The attributes of a config object, also of nested objects, and its public properties.

    Dataclasses, other plain objects, enum members and paths become mappings with the names of
    their classes (``messages.CONFIG_CLASS``). Values without a plain form (a function, an open
    file) are left out, because nothing of the caller is pickled.
    """
    return config.values if isinstance(config, PlainConfig) else _attributes(config, 0)


def _attributes(config: Any, depth: int) -> dict[str, object]:
    names = list(getattr(config, "__dict__", {}))
    if is_dataclass(config):
        names = list(dict.fromkeys([*(item.name for item in fields(config)), *names]))
    attributes = _known({name: _plain(getattr(config, name, None), depth + 1) for name in names})
    wanted = {item.name for item in fields(config)} if is_dataclass(config) else attributes
    computed = _known({name: _plain(value, 1) for name, value in _computed(config, depth)})
    described = (
        _names(type(config)),
        tuple(name for name in attributes if name in wanted),
        computed,
    )
    return {**attributes, CONFIG_CLASS: described}


def _is_key(key: Any) -> bool:
    plain = key.value if isinstance(key, Enum) else key
    return isinstance(plain, Hashable) and type(_plain(plain, 0)) is type(plain)


def _known(values: dict[Any, Any]) -> dict[Any, Any]:
    return {name: value for name, value in values.items() if value is not _LEFT_OUT}


def _names(kind: type) -> tuple[tuple[str, str], ...]:
    """The module and name of a class and of each of its base classes."""
    return tuple((cls.__module__, cls.__qualname__) for cls in kind.__mro__ if cls is not object)


def _computed(config: Any, depth: int) -> Iterator[tuple[str, Any]]:
    """The public properties of a config that can be read, such as ``type`` of LeRobot's."""
    kind = type(config)
    for name in [] if depth else dir(kind):
        if name.startswith("_") or not isinstance(inspect.getattr_static(kind, name), property):
            continue
        with suppress(Exception):
            yield name, getattr(config, name)


def _plain(value: Any, depth: int) -> Any:
    if depth > _MAX_DEPTH or callable(value):
        return _LEFT_OUT
    if isinstance(value, Enum):
        inner = _plain(value.value, depth)
        return {CONFIG_CLASS: (_names(type(value)), None, {}), "value": inner}
    if isinstance(value, _PLAIN):
        return value
    if isinstance(value, os.PathLike):
        text = os.fspath(value)
        named = {CONFIG_CLASS: ((("pathlib", "Path"),), None, {}), "value": text}
        return named if isinstance(value, PurePath) else text
    if isinstance(value, Mapping):
        keys = {k: k.value if isinstance(k, Enum) else k for k in value if _is_key(k)}
        kept = _known({key: _plain(value[k], depth + 1) for k, key in keys.items()})
        return kept if type(value) is dict else {**kept, CONFIG_CLASS: ((), (), {})}
    if isinstance(value, (list, tuple, set, frozenset)):
        plain = [item for item in (_plain(v, depth + 1) for v in value) if item is not _LEFT_OUT]
        return tuple(plain) if isinstance(value, tuple) else plain
    if hasattr(value, "__dict__") or is_dataclass(value):
        return _attributes(value, depth)
    return _LEFT_OUT
