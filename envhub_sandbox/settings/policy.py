"""Policies, limits and timeouts of jails, as frozen, keyword-only dataclasses.

Unknown names and impossible values are refused with ``PolicyError``: a misspelt limit that
silently did nothing would be a security hole.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import field, fields, replace
from numbers import Real
from typing import Any, TypeVar

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.settings.options import nearest, option_name
from envhub_worker.protocol.confinement import DISPLAYS, NETWORKS, PROFILES, Confinement, Limits
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.start_variables import fixed_hash_seed, why_not
from envhub_worker.protocol.text import parse_size

__all__ = [
    "NETWORKS",
    "PROFILES",
    "Limits",
    "Policy",
    "Timeouts",
    "limits_from",
    "policy_from",
    "timeouts_from",
]

RESTARTS = ("never", "on_reset", "transparent")
LANES = ("auto", "frames")


@dataclass(frozen=True, kw_only=True)
class Timeouts:
    """Seconds that one operation may take; None sets no limit.

    Attributes:
        startup_s: From the fork of a jail to the return of the repository's ``make_env``.
        reset_s: One ``reset``.
        step_s: One ``step``.
        call_s: One ``call``, ``get_attr``, ``set_attr`` or ``render``.
        close_s: The environment's own ``close``; then its processes are killed, with a warning.
        idle_s: Between two requests. Then its processes are ended, and the next ``reset`` starts
            new ones; any other request raises an error. None never ends them.
        server_idle_s: How long the worker server, or the container, waits for the next environment
            after the last one was closed; 0 ends it at once. It ends with this process at the
            latest. It keeps a warm interpreter in which no repository's code has run, and no jail.
    """

    startup_s: float | None = 300.0
    reset_s: float | None = 300.0
    step_s: float | None = 300.0
    call_s: float | None = 300.0
    close_s: float | None = 5.0
    idle_s: float | None = None
    server_idle_s: float | None = 30.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name == "server_idle_s" and _is_number(value) and value == 0:
                continue
            if value is not None and not (_is_number(value) and value > 0):
                raise PolicyError(
                    f"{option_name(item.name)} is {value!r}; it takes seconds above 0, or None"
                )


@dataclass(frozen=True, kw_only=True)
class Policy:
    """What a repository's code may reach.

    Attributes:
        profile: Which layers must hold. ``"strict"`` needs all of them; ``"no-userns"`` and
            ``"container"`` are weaker and must be named (``docs/threat-model.md``).
        network: ``"none"``, ``"loopback"`` (a loopback device of its own) or ``"host"``.
        display: ``"none"``, or ``"virtual"``: an X display inside the jail, for code that opens
            windows. It needs Xvfb where the jail runs.
        readable: Additional absolute paths that the jail may read.
        gpu: ``True`` grants all GPUs, ``[0, 2]`` these, in the order of ``nvidia-smi`` (NVIDIA's by
            PCI address, then others): the device nodes for computing and rendering, and the
            devices' own folders of ``/sys``. If one is missing, no jail starts.
        environment: Names of environment variables whose values the jail may see. Those that are
            read when a process starts work as well, or are refused with the reason.
        limits: Hard caps.
        restart: After the worker has died: ``"never"`` starts no new one; ``"on_reset"`` starts one
            at the next ``reset()``; ``"transparent"`` restarts the process that died at once, and
            reports its sub-environments as truncated (``docs/faults.md``).
        restart_budget: Maximum number of such restarts of one environment.
        restart_backoff_s: Seconds to wait before a restart that follows another within a minute;
            they double each time, up to half a minute.
        output: The worker's output: ``"tail"`` keeps the last lines for error messages; a path
            also writes it to this file, and that of further jails to further files; ``"stderr"`` or
            ``"-"`` prints it on this program's stderr.
        record_denials: Record denied system calls, and requests for files outside the jail's own
            folders, in ``env.sandbox.denials()`` and in ``denied`` of the error that ends a jail.
            The jail's first process then answers these calls, which takes longer, also for opening
            files.
        crash_history: How many requests since the last seeded reset are kept for a crash bundle
            (``docs/crashes.md``), within 8 MiB; 0 keeps none and writes no bundles.
        crash_folder: Where crash bundles are written; ``crashes`` in the cache by default.
        prewarm: How many of a suite's next tasks start in the background when a task is first
            reset; this is also the maximum of unused jails. By default one, if tasks are closed
            before the next is reset, on this machine and without a GPU; otherwise none.
        lane: ``"auto"`` steps over shared memory where that is possible, ``"frames"`` never does.
    """

    profile: str = "strict"
    network: str = "none"
    display: str = "none"
    readable: tuple[str, ...] = ()
    gpu: bool | Sequence[int] = False
    environment: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    restart: str = "never"
    restart_budget: int = 100
    restart_backoff_s: float = 0.1
    output: str = "tail"
    record_denials: bool = False
    crash_history: int = 10_000
    crash_folder: str | None = None
    prewarm: int | None = None
    lane: str = "auto"

    def __post_init__(self) -> None:
        _one_of("profile", self.profile, PROFILES)
        _one_of("network", self.network, NETWORKS)
        _one_of("display", self.display, DISPLAYS)
        _one_of("restart", self.restart, RESTARTS)
        _one_of("lane", self.lane, LANES)
        _count("restart_budget", self.restart_budget)
        _seconds("restart_backoff_s", self.restart_backoff_s)
        _count("crash_history", self.crash_history)
        if self.prewarm is not None:
            _count("prewarm", self.prewarm)
        object.__setattr__(self, "output", _path("output", self.output))
        if self.crash_folder is not None:
            object.__setattr__(self, "crash_folder", _path("crash_folder", self.crash_folder))
        object.__setattr__(self, "gpu", _gpu(self.gpu))
        if not isinstance(self.record_denials, bool):
            raise PolicyError(
                f"{option_name('record_denials')} is {self.record_denials!r}; it takes True or "
                "False"
            )
        # the dataclass is frozen, so this sets a field to its normal form
        object.__setattr__(self, "readable", _texts("readable", self.readable))
        object.__setattr__(self, "environment", _texts("environment", self.environment))
        for name in self.environment:
            _granted(name, os.environ.get(name, ""))
        object.__setattr__(self, "limits", _checked(self.limits))
        for path in self.readable:
            if not os.path.isabs(path):
                raise PolicyError(
                    f"{option_name('readable')} has {path!r}; it takes absolute paths"
                )

    def confinement(self) -> Confinement:
        """The part of the policy for the worker, with the values of the named variables.

        Raises:
            PolicyError: A variable with this value cannot be granted.
        """
        named = {name: os.environ[name] for name in self.environment if name in os.environ}
        granted = {**fixed_hash_seed(os.environ), **named}
        for name, value in granted.items():
            _granted(name, value)
        return Confinement(
            profile=self.profile,
            network=self.network,
            readable=self.readable,
            gpu=_gpu(self.gpu),
            environment=granted,
            limits=self.limits,
            record_denials=self.record_denials,
            display=self.display,
        )


T = TypeVar("T", Policy, Limits, Timeouts)


def policy_from(
    value: Policy | Mapping[str, Any] | None, limits: Limits | Mapping[str, Any] | None
) -> Policy:
    """Make a policy from the arguments of ``make_env``.

    A mapping of ``limits`` changes the limits that it names. A ``Limits`` object has all limits,
    which is ambiguous if the policy has limits of its own.

    Raises:
        PolicyError: The policy is invalid, or the limits are ambiguous.
    """
    policy = _from(Policy, value, "policy")
    chosen = limits_from(limits)
    if limits is None or chosen is None:
        return policy
    if isinstance(limits, Mapping):
        named = {name: getattr(chosen, name) for name in limits}
        chosen = replace(policy.limits, **named)
    elif policy.limits not in (Limits(), chosen):
        raise PolicyError(
            "limits and the limits of the policy are both given: give one of them, or a mapping "
            "with the limits that differ from the policy's"
        )
    return replace(policy, limits=chosen)


def limits_from(value: Limits | Mapping[str, Any] | None) -> Limits | None:
    """Make limits from the argument of ``make_env``."""
    return None if value is None else _from(Limits, value, "limits")


def timeouts_from(value: Timeouts | Mapping[str, Any] | None) -> Timeouts:
    """Make timeouts from the argument of ``make_env``."""
    return _from(Timeouts, value, "timeouts")


def _from(cls: type[T], value: T | Mapping[str, Any] | None, argument: str) -> T:
    if value is None:
        return cls()
    if isinstance(value, cls):
        return value
    if not isinstance(value, Mapping):
        raise PolicyError(
            f"{argument} is {value!r}; it takes a {cls.__name__}, or a mapping with keys such as "
            f"{fields(cls)[0].name!r}"
        )
    names = [item.name for item in fields(cls)]
    unknown = [name for name in value if name not in names]
    if unknown:
        raise PolicyError(
            f"{argument} has no field {', '.join(map(str, unknown))}{nearest(unknown[0], names)}; "
            f"it has {', '.join(names)}"
        )
    values = dict(value)
    if cls is Policy and isinstance(values.get("limits"), Mapping):
        values["limits"] = _from(Limits, values["limits"], "limits")
    return cls(**values)


def _one_of(name: str, value: str, permitted: tuple[str, ...]) -> None:
    if value not in permitted:
        raise PolicyError(f"{option_name(name)} is {value!r}; it is one of {', '.join(permitted)}")


def _count(name: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise PolicyError(f"{option_name(name)} is {value!r}; it takes a whole number, 0 or more")


def _path(name: str, value: object) -> str:
    if not isinstance(value, (str, os.PathLike)) or not os.fspath(value):
        raise PolicyError(f"{option_name(name)} is {value!r}; it takes a path")
    return str(os.fspath(value))


def _seconds(name: str, value: Any) -> None:
    if not (_is_number(value) and 0 <= value < float("inf")):
        raise PolicyError(f"{option_name(name)} is {value!r}; it takes seconds, 0 or more")


def _granted(name: str, value: str) -> None:
    reason = why_not(name, value)
    if reason:
        raise PolicyError(f"{option_name('environment')} has {name}, which {reason}")


def _gpu(value: object) -> bool | tuple[int, ...]:
    if isinstance(value, bool):
        return value
    indices = _members(value) or ()
    if not indices or any(type(index) is not int or index < 0 for index in indices):
        raise PolicyError(
            f"{option_name('gpu')} is {value!r}; it takes True, False or a list of indices"
        )
    return tuple(sorted(set(indices)))


_OPTIONAL_LIMITS = frozenset({"cpu_time_s", "file_bytes"})
_LEAST_LIMITS = {
    "memory_bytes": 1 << 20,
    "open_files": 32,
    "disk_bytes": 1 << 16,
    "disk_files": 100,
    "message_bytes": 1 << 20,
}
"""With less, no jail starts, or one cannot say why it does not."""


def _texts(name: str, value: object) -> tuple[str, ...]:
    members = _members(value)
    if members is None or not all(isinstance(item, str) for item in members):
        raise PolicyError(f"{option_name(name)} is {value!r}; it takes a list of strings")
    return members


def _members(value: object) -> tuple[Any, ...] | None:
    """The members of any sequence, such as a list of a Hydra configuration; None for a text."""
    is_list = isinstance(value, Sequence) and not isinstance(value, (str, bytes))
    return tuple(value) if is_list else None  # type: ignore[arg-type]


def _checked(limits: Limits) -> Limits:
    if not isinstance(limits, Limits):
        raise PolicyError(f"policy: limits takes a Limits, not {type(limits).__name__}")
    return Limits(
        **{item.name: _whole(item.name, getattr(limits, item.name)) for item in fields(limits)}
    )


def _whole(name: str, value: Any) -> Any:
    if value is None and name in _OPTIONAL_LIMITS:
        return None
    if isinstance(value, str) and name.endswith("_bytes"):
        try:
            value = parse_size(value)
        except ValueError as error:
            raise PolicyError(f"{option_name(name)} is {value!r}; {error}") from None
    least = _LEAST_LIMITS.get(name, 1)
    if not (_is_number(value) and value >= least and value // 1 == value):
        takes = f"a whole number, {least} or more"
        raise PolicyError(f"{option_name(name)} is {value!r}; it takes {takes}")
    return int(value)


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
