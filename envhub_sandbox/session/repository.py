"""One repository under one policy: what all its environments share, and the errors of its start.

``provenance_of`` says what ran. A pickle of a proxy holds a ``Recipe``, the arguments that made it,
and makes a fresh environment of the same commit in a worker of its own. It never holds a token or a
login: the other side uses its own. ``plain_config`` makes plain data of a caller's config object.
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
"""What Gymnasium calls every environment of ours."""
_MAKERS = "envhub_sandbox.integrations.gym"
_SPEC_FACTS = frozenset({"max_episode_steps", "reward_threshold", "nondeterministic"})
"""What is true of the environment in a sandbox as well."""


@dataclass(frozen=True)
class PlainConfig:
    """The plain data of a caller's config object, which ``make_env`` takes in its place."""

    hub_path: str
    values: dict[str, object]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """The arguments of ``make_env``, with the commit pinned.

    Attributes:
        make_env: The function that takes them; it travels by its name.
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
        """Fresh environments: what ``make_env`` returns and raises."""
        return self.make_env(self._cfg, **self._options)

    def make_one(self, suite: str, task: int | str) -> Any:
        """One fresh environment of them."""
        return self.make()[suite][task]

    def spec(self, suite: str, task: int | str, facts: Mapping[str, Any] | None) -> EnvSpec:
        """A spec from which ``gym.make`` makes one environment again, in a sandbox.
        ``facts``: those of the repository's own spec. Trust: input from the worker, of which
        nothing says how the environment is made.
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
            options["endpoint"] = None  # it may come with a login here
        return options

    @property
    def differing(self) -> dict[str, Any]:
        """The options that are not the default ones, as JSON has them where it can."""
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
    """What ran, as plain data: enough to run it again, or to see that it cannot be the same.
    ``report``: the layers of confinement. Trust: interpreter and packages are the worker's words.
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
    """The fields of a policy, timeouts or limits that differ from the default; other values."""
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
    """What the environments of one ``make_env`` have in common. Opens nothing: see ``Launcher``.

    Args:
        arguments: Those of the repository's ``make_env``.
        runtime: The interpreter and the packages of the jails.
        copy: Whether observations are copied for the caller, or lent.
        installed: What was installed for it, for the provenance.
        advice: Makes advice about a missing module, for the error's text.
        of_its_day: Makes advice if today's packages may be at fault; empty for other errors.

    Attributes:
        label: Repository, commit and entry file, for errors.
        wire_limits: Bounds on what a jail may send.
        warnings: Warnings of the repository in any jail.
        latest_report, latest_profile: The layers and the profile of the jail that was opened last.
        places: Where each worker of an environment runs, or will run.
        jail_numbers: Numbers the jails, for files of their output.
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
        self._in_use: list[SharedLock] = []
        self._holders: set[object] = set()
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
        """Keep its files and packages from being removed, until each holder has let go."""
        self._holders.add(holder)
        self._lock_files()

    def _lock_files(self) -> None:
        if self._in_use:
            return
        folders = [snapshot.root.parent for snapshot in (self.snapshot, *self.snapshot.assets)]
        if os.path.isabs(self.runtime.packages):  # else they have a name, on another host
            folders.append(Path(self.runtime.packages).with_name(RECORD))
        self._in_use = [SharedLock(folder) for folder in folders]

    def let_go(self, holder: object) -> None:
        """Let the files be removed, after the last holder. Idempotent, also after an interrupt."""
        self._holders.discard(holder)
        if self._holders:
            return
        for lock in self._in_use:
            lock.release()
        self._in_use = []

    @contextmanager
    def named(self) -> Iterator[None]:
        """Put the repository's name in front of the errors of this project."""
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
        """What runs: see ``provenance_of``. ``report``: None for that of the latest jail."""
        layers = self.latest_report if report is None else report
        run = self.installed, self.latest_profile, self.places
        return provenance_of(self.snapshot, manifest, layers, *run)

    @contextmanager
    def starting(self, deadline: Deadline) -> Iterator[None]:
        """Say in an error what took too long, and write a crash bundle for a death."""
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
        """Write a crash bundle and name it in the error. What hinders that is only logged.

        All but the error is None before there is a jail.
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
        # a bundle elsewhere than in the cache might be anybody's
        options = " --grant" if self.policy.crash_folder else ""
        again = f"To try the same again: envhub replay {shlex.quote(error.bundle)}{options}"
        error.args = (f"{error.args[0]}\n{again}", *error.args[1:])
        CRASHES.info("%s: crash bundle %s", self.label, bundle)


# --- a caller's config object


def plain_config(config: Any) -> dict[str, object]:
    """The attributes of a config object with nested ones, and its own public properties.

    Dataclasses and other plain objects become mappings which say what their classes are called
    (``messages.CONFIG_CLASS``), and so do members of enums and paths. What has no plain form (a
    function, an open file) is left out: nothing of the caller is pickled.
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
    """Module and name of a class and of those that it inherits from."""
    return tuple((cls.__module__, cls.__qualname__) for cls in kind.__mro__ if cls is not object)


def _computed(config: Any, depth: int) -> Iterator[tuple[str, Any]]:
    """The public properties of a config that can be had: LeRobot's have their ``type`` so."""
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
