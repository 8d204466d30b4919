"""Turns replies into the expected message or into an exception.

Only this module makes exceptions from what a server or a runner says: their classes come from fixed
tables, and their texts are cut and made printable.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from envhub_sandbox.errors import (
    DependencyError,
    EnvHubError,
    PolicyError,
    RemoteProtocolError,
    SandboxUnavailableError,
    ServerBusyError,
    SnapshotIntegrityError,
    VersionMismatchError,
    WorkerDiedError,
    WorkerError,
    known_reason,
    load_error,
    remote_error,
)
from envhub_sandbox.settings.options import option_name
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.confinement import Reason
from envhub_worker.protocol.text import continued, printable, quoted

_WORD_CHARS = 100
"""The most characters of an operation, a signal, or a reason."""
_PROFILE = 'profile "(strict|no-userns|container)"'
_LIMIT = r"\((memory_bytes|disk_bytes|disk_files|cpu_time_s)\)"


class UnreachableError(SandboxUnavailableError):
    """There is no server, or it ended before it answered."""


class RunnersDiedError(WorkerDiedError):
    """Runners of a kept jail have died; the other runners have answered.

    Users never see it: a recovery handles it, or ``first`` is raised instead.

    Attributes:
        replies: The replies, decoded, in the order of the request; None for a dead runner.
        deaths: Each dead runner's error, by the runner's index in the request.
        jail_gone: Whether the jail has ended, too.
    """

    def __init__(
        self, replies: Sequence[Any], deaths: dict[int, WorkerDiedError], *, jail_gone: bool = False
    ) -> None:
        self.first = next(iter(deaths.values()))
        super().__init__(str(self.first), reason=self.first.reason)
        self.replies = list(replies)
        self.deaths = deaths
        self.jail_gone = jail_gone


# --- expected replies ----------------------------------------------------------------------------


def expect_reply(reply: m.Message, kind: type[m.M]) -> m.M:
    """Return the reply if it is of this kind.
    Raises ``RemoteProtocolError``: it is another message; the error for a refusal or a death, if
    it is one of these.
    """
    if isinstance(reply, m.Refusal) and kind is not m.Refusal:
        raise refusal(reply)
    if isinstance(reply, m.Death) and kind is not m.Death:
        raise death(reply)
    return typed_reply(reply, kind)


def check_reply(reply: m.Message) -> None:
    """Raise the repository's exception, if a runner's reply has one.
    Raises ``RemoteProtocolError``: the runner sent a message of the server's.
    """
    if isinstance(reply, m.RaisedException):
        raise raised(reply)
    if reply.kind < m.FIRST_RUNNER_KIND:
        raise RemoteProtocolError(f"a runner sent {type(reply).__name__}, as a server does")


def typed_reply(reply: m.Message, kind: type[m.M] | tuple[type[m.M], ...]) -> m.M:
    """Return the reply if it is of this kind, or of one of several. Raises if it is not."""
    if isinstance(reply, kind):
        return reply
    kinds = kind if isinstance(kind, tuple) else (kind,)
    wanted = " or ".join(kind.__name__ for kind in kinds)
    raise RemoteProtocolError(
        f"the worker answered with {type(reply).__name__} instead of {wanted}"
    )


# --- messages of servers -------------------------------------------------------------------------


def _named(text: str) -> str:
    """The text, with a profile or a limit written as the user sets it: by argument or option."""
    text = re.sub(_PROFILE, lambda match: option_name("profile", match[1]), text)
    return re.sub(_LIMIT, lambda match: f"({option_name(match[1])})", text)


def refusal(reply: m.Refusal) -> Exception:
    """The error for a refused request. Trust: text from the worker."""
    message = printable(reply.message)
    if reply.error == "SandboxUnavailableError":
        layer = f"{printable(reply.missing)}: " if reply.missing else ""
        fix = f"\n{_named(printable(reply.fix))}" if reply.fix else ""
        return SandboxUnavailableError(f"this host cannot enforce {layer}{message}{fix}")
    if reply.error == "WorkerDiedError":
        return WorkerDiedError(message, reason="gone")
    if busy := reply.busy:
        return ServerBusyError(
            message, quota=busy.quota, used=busy.used, limit=busy.limit, retry_s=busy.retry_s
        )
    if reply.error == "DependencyError":
        return DependencyError(message, reason=known_reason(reply.missing))
    return _REFUSALS.get(reply.error, WorkerError)(message)


_REFUSALS: dict[str, type[Exception]] = {
    kind.__name__: kind for kind in (PolicyError, SnapshotIntegrityError, VersionMismatchError)
}


_REASONS: dict[Reason, str] = {
    "exit": "it exited",
    "signal": "a signal ended it",
    "out-of-memory": "it ran out of memory",
    "cpu-limit": "it used up its cpu limit",
    "disk-limit": "it used up its disk limit",
    "protocol": "it broke the rules of the wire and was killed",
    "killed": "it was closed",
    "zygote": "the process that forks workers ended",
    "idle": "the server ended it",
    "unavailable": "it could not be confined",
}


def death(reply: m.Death) -> WorkerDiedError:
    """The error for a jail that ended. Trust: text from the worker."""
    reason: Any = one_line(reply.reason, _WORD_CHARS)
    signal = None if reply.signal is None else one_line(reply.signal, _WORD_CHARS)
    operation = one_line(reply.operation, _WORD_CHARS)
    why = _named(printable(reply.detail))
    last = printable(reply.tail, len(reply.tail))  # as much as the policy's output_bytes
    how = _REASONS.get(reason, reason)
    if signal:
        how += f" ({signal})"
    elif reply.exit_code is not None:
        how += f" (exit code {reply.exit_code})"
    during = f" during {operation}" if operation else ""
    detail = f"\n{why}" if why else ""
    tail = f"\nIts last output:\n{quoted(last)}" if last else ""
    return WorkerDiedError(
        f"the worker process died{during}: {how}{detail}{tail}",
        exit_code=reply.exit_code,
        signal=signal,
        reason=reason,
        log_tail=last,
        request=operation or None,
        detail=why,
    )


# --- messages of runners -------------------------------------------------------------------------

_LOADING = {
    "import": "the entry file could not be imported",
    "make_env": "its make_env failed",
    "return": "its make_env returned something unusable",
}
_LOADERS_OWN = (".EntryError", ".ArgumentsError")
"""Exceptions of our own loader, whose tracebacks say nothing about the repository."""


def raised(reply: m.RaisedException) -> EnvHubError:
    """The error for an exception of the repository. Trust: text from the worker."""
    reply = m.RaisedException(
        reply.builtin,
        one_line(reply.type_name, 512),
        printable(reply.message),
        printable(reply.traceback, 32_768),
        reply.stage,
    )
    if reply.stage not in _LOADING:
        return remote_error(reply.builtin, reply.type_name, reply.message, reply.traceback)
    failure, message = _LOADING[reply.stage], continued(reply.message)
    if reply.stage == "return":
        return load_error("ValueError", message)
    cause: Any = remote_error(reply.builtin, reply.type_name, reply.message, reply.traceback)
    if reply.builtin == "ModuleNotFoundError":
        error: EnvHubError = DependencyError(f"{failure}: {message}", reason="module")
    elif reply.type_name.endswith(_LOADERS_OWN):
        return load_error(reply.builtin, message)
    else:
        error = load_error(reply.builtin, f"{failure}: {reply.type_name}: {message}")
    error.__cause__ = cause
    return error
