"""Runs one payload twice, outside and inside of a sandbox, and keeps what became of it.
A payload is a function in ``hostile/payloads``. What it says of itself is only a detail: whether
an attack succeeded is decided by a function of the test that looks from outside, at a listener, a
file, a victim, the process table, or (where something is to be stolen) for a random token in what
came back through the channels that the repository has anyway."""

import contextlib
import json
import os
import secrets
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError
from tests.attacks.expectations import MEASURED, PLAIN, depends_on_load, not_stopped
from tests.support.processes import eventually

HOSTILE = Path(__file__).with_name("hostile")
USER = "root" if os.geteuid() == 0 else "user"
TIMEOUTS = {"startup_s": 120.0, "call_s": 90.0, "reset_s": 90.0, "step_s": 90.0}
_PROVED: set[tuple[str, ...]] = set()
"""Attacks whose control has succeeded in this process: that is the same for every profile."""
OUTSIDE, ANSWER = "outside", "by its answer"
"""Who says whether an attack succeeded: the world around the jail, or the payload."""
Succeeded = Callable[["Run"], object]


@dataclass
class Run:
    """One run of a payload."""

    alias: str
    inside: bool
    value: Any = None
    error: str = ""

    @property
    def text(self) -> str:
        return json.dumps(self.value, default=repr) + self.error

    def pids(self) -> list[int]:
        return pids_named(self.alias)


@dataclass(frozen=True)
class Row:
    """One line of the table of attacks."""

    attack: str
    family: str
    profile: str
    user: str
    control: str
    inside: str
    detail: str
    judged: str = OUTSIDE


class StoppedNowError(AssertionError):
    """An attack did not get through that the documents say gets through, or its control did not."""


class Attacks:
    """Where a payload is run as a control and inside."""

    inside: Callable[..., contextlib.AbstractContextManager[Run]]
    judge: Callable[..., None]
    named: Callable[[str], tuple[str, str]]

    def attack(
        self,
        title: str,
        payload: str,
        succeeded: Succeeded,
        *,
        inside: Mapping[str, Any] | None = None,
        policy: Mapping[str, Any] | None = None,
        limits: Mapping[str, Any] | None = None,
        secret: str = "",
        before: Callable[[], object] = lambda: None,
        impossible: str = "",
        judged: str = OUTSIDE,
        **arguments: Any,
    ) -> None:
        """Run the payload as a control, where it must succeed, and inside, where it must not.
        One control is for all profiles: it has none.

        Args:
            title: The attack's name in the table.
            payload: Function in ``hostile/payloads``.
            succeeded: Looks from outside, while the payload's process is still there.
            inside: Arguments that differ inside.
            policy: Fields of the policy besides the profile.
            limits: The policy's limits.
            secret: What the control's process holds in its memory.
            before: Runs before each half, to undo what the other one did.
            impossible: Why there is no control here; the attack then counts as no proof.
            judged: ``ANSWER`` where ``succeeded`` has nothing but the payload's word.
            **arguments: For the payload.
        """
        control = "not possible" if impossible else "succeeds"
        if not impossible and (*self.named(title), payload) not in _PROVED:
            before()
            with control_run(payload, arguments, secret) as run:
                if not succeeded(run):
                    raise StoppedNowError(f"the control of {title!r} failed: {run.text[-3000:]}")
            _PROVED.add((*self.named(title), payload))
        before()
        place = {name: one for name, one in (("policy", policy), ("limits", limits)) if one}
        with self.inside(payload, {**arguments, **(inside or {})}, **place) as run:
            through = bool(succeeded(run))
        self.judge(title, control, through, run.text, impossible, judged)

    def steal(self, title: str, payload: str, wanted: str, /, **arguments: Any) -> None:
        """``attack`` that succeeds where ``wanted`` comes back."""
        self.attack(title, payload, lambda run: wanted in run.text, **arguments)


@dataclass
class Arena(Attacks):
    """Where one test attacks: one profile, as the user that this process is."""

    profile: str
    family: str
    rows: list[Row] = field(default_factory=list)
    report: list[dict[str, Any]] = field(default_factory=list)

    def judge(
        self,
        title: str,
        control: str,
        through: bool,
        detail: str,
        impossible: str = "",
        judged: str = OUTSIDE,
    ) -> None:
        verdict = "NOT STOPPED" if through else "no proof" if impossible else "stopped"
        note = impossible or (_brief(detail) if not through else "")
        row = Row(title, self.family, self.profile, USER, control, verdict, note, judged)
        self.rows.append(row)
        if depends_on_load(title, self.conditions()):
            return
        reason = not_stopped(title, self.conditions())
        if reason is None:
            assert not through, f"{title!r} succeeded inside ({self.profile}): {detail[-3000:]}"
        elif not through:
            raise StoppedNowError(f"{title!r} is stopped now; expectations say otherwise: {reason}")

    def named(self, title: str) -> tuple[str, str]:
        """What tells an attack from all others."""
        return self.family, title

    def conditions(self) -> list[str]:
        details = [layer["detail"] for layer in self.report if layer["layer"] == "memory"]
        measured = any("measured by" in detail for detail in details)
        plain = [PLAIN] if USER == "user" else []
        measures = [MEASURED, f"{self.profile}, {MEASURED}"] if measured else []
        return [self.profile, *plain, *measures]

    @contextlib.contextmanager
    def inside(
        self,
        payload: str,
        arguments: Mapping[str, Any],
        policy: Mapping[str, Any] | None = None,
        limits: Mapping[str, Any] | None = None,
    ) -> Iterator[Run]:
        """Run a payload in a jail of its own; the jail lives as long as the context."""
        run = Run(new_alias(), True)
        with self.environment(policy, limits) as env:
            env.reset()
            self.report = env.sandbox.report()  # before the payload, which may be the jail's end
            call(env, run, payload, arguments)
            yield run

    @contextlib.contextmanager
    def environment(
        self,
        policy: Mapping[str, Any] | None = None,
        limits: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> Iterator[Any]:
        options = {"limits": limits, "timeouts": TIMEOUTS, **self.place(policy or {}), **options}
        with make_env(str(HOSTILE), **options) as suites:
            yield suites.env

    def place(self, policy: Mapping[str, Any]) -> dict[str, Any]:
        return {"policy": {"profile": self.profile, **policy}}


@dataclass(frozen=True)
class OpenJail(Attacks):
    """The same attacks in a jail that is open already, and is left open for the next one."""

    arena: Arena
    env: Any
    prefix: str = ""

    def judge(self, title: str, *found: Any, **more: Any) -> None:
        self.arena.judge(self.prefix + title, *found, **more)

    def named(self, title: str) -> tuple[str, str]:
        return self.arena.named(self.prefix + title)

    @contextlib.contextmanager
    def inside(self, payload: str, arguments: Mapping[str, Any]) -> Iterator[Run]:
        yield run_in(self.env, payload, **arguments)


class LastingJail:
    """A jail for many attacks of one profile; another one follows where an attack was its end."""

    def __init__(self, profile: str) -> None:
        self.profile = profile
        self._held = contextlib.ExitStack()
        self._env: Any = None

    def open(self, family: str) -> OpenJail:
        arena = Arena(self.profile, family)
        if self._env is None or self._env.sandbox.stats()["state"] != "READY":
            self.close()
            self._env = self._held.enter_context(arena.environment())
            self._env.reset()
        arena.report = self._env.sandbox.report()
        return OpenJail(arena, self._env)

    def close(self) -> None:
        self._env = None
        self._held.close()


def run_in(env: Any, payload: str, **arguments: Any) -> Run:
    run = Run(new_alias(), True)
    call(env, run, payload, arguments)
    return run


def call(env: Any, run: Run, payload: str, arguments: Mapping[str, Any]) -> None:
    try:
        [run.value] = env.call("attack", payload, dict(arguments), run.alias)
    except EnvHubError as error:
        run.error = "".join(traceback.format_exception(error))


@contextlib.contextmanager
def control_run(payload: str, arguments: Mapping[str, Any], secret: str = "") -> Iterator[Run]:
    run = Run(new_alias(), False)
    with answered(start_control(payload, arguments, run.alias), run, secret):
        yield run


@contextlib.contextmanager
def answered(process: subprocess.Popen[bytes], run: Run, secret: str = "") -> Iterator[None]:
    """Note what ``hostile/outside.py`` answers in a process, which lives as long as the context."""
    try:
        process.stdin.write(secret.encode() + b"\n")
        process.stdin.flush()
        answer = _last_line(process)
        run.value, run.error = answer["value"], answer["error"]
        yield
    finally:
        process.stdin.close()
        process.stdout.close()
        _end(process, run.alias)


def start_control(
    payload: str, arguments: Mapping[str, Any], alias: str, **options: Any
) -> subprocess.Popen[bytes]:
    words = [str(HOSTILE / "outside.py"), payload, json.dumps(dict(arguments)), alias]
    return subprocess.Popen(
        [sys.executable, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
        **options,
    )


def _last_line(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """The runner's line of JSON; whatever the payload prints comes before it."""
    for line in process.stdout:
        if line.startswith(b'{"value"'):
            return dict(json.loads(line))
    return {"value": None, "error": f"the process ended: {process.wait()}"}


def _end(process: subprocess.Popen[bytes], alias: str) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kill_named(alias)


def new_alias() -> str:
    """A process name that nobody else has; the kernel keeps 15 bytes."""
    return f"atk-{secrets.token_hex(4)}"


def token() -> str:
    return secrets.token_hex(16)


def pids_named(alias: str) -> list[int]:
    """The live processes of a name, in any pid namespace below ours."""
    found = []
    for name in os.listdir("/proc"):
        if name.isdigit() and _comm(name) == alias and _runs(name):
            found.append(int(name))
    return sorted(found)


def kill_named(alias: str) -> None:
    for pid in pids_named(alias):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    assert eventually(lambda: not pids_named(alias))


def _comm(pid: str) -> str:
    return _read(f"/proc/{pid}/comm").strip()


def _runs(pid: str) -> bool:
    """Whether any of its threads does: without its first one a process looks like a zombie."""
    fields = _read(f"/proc/{pid}/stat").rpartition(")")[2].split()
    return bool(fields) and (fields[0] not in ("Z", "X") or int(fields[17]) > 1)


def _read(path: str) -> str:
    with contextlib.suppress(OSError), open(path) as file:
        return file.read()
    return ""


def _brief(detail: str) -> str:
    lines = [line.strip() for line in detail.splitlines() if line.strip()]
    return (lines[-1] if lines else "")[:120]
