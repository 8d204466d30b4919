"""The errors that a caller can get.

::

    EnvHubError
      HubReferenceError (ValueError)
      SnapshotError
        SnapshotTooLargeError
        SnapshotIntegrityError
        RepositoryUnavailableError (OSError)
      PolicyError (ValueError)
      BundleError (ValueError)
      VideoError
      LockError (ValueError)
        LockDriftError
      ActionError (ValueError)
        ActionTypeError (TypeError)
      SandboxUnavailableError
      DependencyError (ModuleNotFoundError)
      LoadError
        LoadAttributeError (AttributeError), LoadValueError (ValueError), ...
      WorkerError
        WorkerStartupError
        WorkerDiedError
        WorkerTimeoutError (TimeoutError, multiprocessing.TimeoutError)
        ServerBusyError
      ProtocolError
        LocalProtocolError
        RemoteProtocolError
          MessageTooLargeError
          VersionMismatchError
      RemoteEnvError
        RemoteAttributeError (AttributeError), RemoteValueError (ValueError), ...
        RemoteResetNeeded (gymnasium.error.ResetNeeded), ...

A remote exception arrives as text. ``remote_error`` looks up its builtin base class in a fixed
table, so ``except AttributeError`` works although nothing of the worker is imported. Every warning
of the repository is a ``RemoteEnvWarning``.
"""

from __future__ import annotations

import builtins
import multiprocessing
import sys
from functools import cache
from typing import Any, Literal, get_args

from envhub_worker.protocol.confinement import Reason
from envhub_worker.protocol.errors import EnvHubError as EnvHubError
from envhub_worker.protocol.errors import LocalProtocolError as LocalProtocolError
from envhub_worker.protocol.errors import MessageTooLargeError as MessageTooLargeError
from envhub_worker.protocol.errors import ProtocolError as ProtocolError
from envhub_worker.protocol.errors import RemoteProtocolError as RemoteProtocolError
from envhub_worker.protocol.errors import VersionMismatchError as VersionMismatchError
from envhub_worker.protocol.text import continued, printable

DependencyReason = Literal[
    "requirement", "resolution", "index", "integrity", "size", "interpreter", "module", "other"
]


class HubReferenceError(EnvHubError, ValueError):
    """A hub reference is invalid; the text says what to write instead."""


class SnapshotError(EnvHubError):
    """A repository's files could not be downloaded, or are not usable."""


class SnapshotTooLargeError(SnapshotError):
    """The repository is over the limit of bytes or files."""


class SnapshotIntegrityError(SnapshotError):
    """A file differs from the pinned commit."""


class RepositoryUnavailableError(SnapshotError, OSError):
    """The Hub did not give the repository, revision or file; ``__cause__`` says why."""

    __str__ = Exception.__str__


class PolicyError(EnvHubError, ValueError):
    """A policy, limit or timeout has an unknown name or an impossible value."""


class BundleError(EnvHubError, ValueError):
    """A crash bundle is not valid."""


class VideoError(EnvHubError):
    """A video cannot be written, because of the frames, the file, or a missing package."""


class LockError(EnvHubError, ValueError):
    """A lock file cannot be read or written, or is not valid."""


class LockDriftError(LockError):
    """Files, packages or spaces differ from the lock, and are not used.

    Attributes:
        drifts: The differences, one line each.
    """

    def __init__(self, message: str, drifts: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.drifts = drifts


class ActionError(EnvHubError, ValueError):
    """Actions of a wrong shape, dtype or structure. Nothing was sent; the env is still usable."""

    def __init__(self, message: str) -> None:
        # it quotes the space, of which Gymnasium prints a Text's characters as they are
        super().__init__(printable(message))


class ActionTypeError(ActionError, TypeError):
    """The actions are not a batch, for example a single number."""


class SandboxUnavailableError(EnvHubError):
    """This host cannot enforce the policy; the text names the layer, the reason and the fix."""


class DependencyError(EnvHubError, ModuleNotFoundError):
    """A package that the repository needs is missing; the repository does not run.

    Attributes:
        reason: ``"requirement"``: a declared requirement is not supported; ``"resolution"``: no
            versions satisfy all requirements; ``"index"``: the package index did not answer;
            ``"integrity"``: a package does not have the expected hash; ``"size"``: the packages
            have more bytes or files than permitted; ``"interpreter"``: no interpreter of this
            machine fits; ``"module"``: the repository imports a module that its interpreter does
            not have; ``"other"``: the text says the reason.
    """

    def __init__(self, message: str, *, reason: DependencyReason = "other") -> None:
        super().__init__(message)
        self.reason: DependencyReason = reason

    __str__ = Exception.__str__  # ImportError's does not look at args


class LoadError(EnvHubError):
    """The repository's entry point cannot be imported, or returned no environment.

    The error is also the builtin that LeRobot's loader would raise: ``AttributeError`` without a
    ``make_env``, ``ValueError`` if it returned no environment, otherwise the repository's own.
    """


class WorkerError(EnvHubError):
    """The worker process failed."""


class WorkerStartupError(WorkerError):
    """The worker did not start."""


class ServerBusyError(WorkerError):
    """A server has no room now: a quota of the client's key is used up. The env is unchanged.

    ``RemoteSandbox(retry_s=...)`` waits instead.

    Attributes:
        quota: ``"sessions"``, ``"jails"``, ``"runners"``, ``"processes"``, ``"open_files"``,
            ``"disk_files"``, or in bytes ``"memory"``, ``"disk"`` and ``"inflight"``;
            ``"draining"`` if the server is ending; empty if the server did not say.
        used: How much of the quota the key uses.
        limit: How much the key may use.
        retry_s: Seconds until the client may ask again.
    """

    def __init__(
        self, message: str, *, quota: str = "", used: int = 0, limit: int = 0, retry_s: float = 1.0
    ) -> None:
        super().__init__(message)
        self.quota = quota
        self.used = used
        self.limit = limit
        self.retry_s = retry_s


class WorkerDiedError(WorkerError):
    """The process that ran the environment ended.

    Attributes:
        exit_code: The exit code, or None when a signal ended it.
        signal: The name of the signal (``"SIGKILL"``), or None.
        reason: ``"exit"``, ``"signal"``, ``"out-of-memory"``, ``"cpu-limit"``, ``"disk-limit"``;
            ``"protocol"``: it sent an invalid message; ``"zygote"``: the process that forks
            workers ended; ``"unavailable"``: it could not be confined; ``"killed"``: it was
            closed, or given up; ``"idle"``: it was idle for ``idle_s``; ``"server"``: the worker
            server ended; ``"connection"``: the connection to another host was lost; ``"gone"``:
            the server does not know the process any more.
        log_tail: The last lines of the process's output, control characters escaped.
        request: The operation that the process was serving (``"step"``), or None.
        detail: The numbers, if a limit was the reason.
        repository: The repository, commit and entry file, as in ``org/repo@0123456789ab:env.py``.
        bundle: The folder with everything that led there, for ``envhub replay``, or None.
    """

    def __init__(
        self,
        message: str,
        *,
        exit_code: int | None = None,
        signal: str | None = None,
        reason: Reason = "exit",
        log_tail: str = "",
        request: str | None = None,
        detail: str = "",
    ) -> None:
        super().__init__(message)
        self.repository: str | None = None
        self.bundle: str | None = None
        self.detail = detail
        self.exit_code = exit_code
        self.signal = signal
        self.reason: Reason = reason
        self.log_tail = log_tail
        self.request = request


class WorkerTimeoutError(WorkerError, TimeoutError, multiprocessing.TimeoutError):
    """The worker did not answer in time. ``reset()`` brings the environment back.

    Attributes:
        request: The requested operation (``"step"``), or None.
        timeout_s: How long the client waited.
        worker: The state of each of its processes: ``"running"``, ``"waiting"``, ``"stopped"`` or
            ``"gone"``. Empty if the server did not say.
        repository: The repository, commit and entry file, as in ``org/repo@0123456789ab:env.py``.
        bundle: As in ``WorkerDiedError``, if the process was ended at once.
    """

    def __init__(
        self, message: str, *, request: str | None = None, timeout_s: float | None = None
    ) -> None:
        super().__init__(message)
        self.request = request
        self.timeout_s = timeout_s
        self.worker: tuple[str, ...] = ()
        self.repository: str | None = None
        self.bundle: str | None = None


class RemoteEnvError(EnvHubError):
    """The repository's code raised. Trust: every attribute is text from the worker.

    Attributes:
        type_name: The class, as the worker named it (``"mypkg.Oops"``).
        message: ``str()`` of the exception.
        traceback: The formatted traceback, with the names of the repository's files.
        where: The traceback's last line in the repository's own files, with the author's name of
            the file; may be empty. ``str()`` ends with it.
        file, line: The file in the repository and the number of that line; empty and 0 for none.
    """

    def __init__(self, type_name: str, message: str, traceback: str = "") -> None:
        # not super(): a twin's builtin base class may take other arguments
        Exception.__init__(self, f"{type_name}: {continued(message)}" if message else type_name)
        self.type_name = type_name
        self.message = message
        self.traceback = traceback
        self.where = self.file = ""
        self.line = 0

    def __reduce__(self) -> tuple[object, ...]:
        name = type(self).__name__.removeprefix("Remote")
        builtin = name if (RemoteEnvError, name) in _TWINS else f"{_GYMNASIUM}.{name}"
        return (
            remote_error,
            (builtin, self.type_name, self.message, self.traceback),
            {**vars(self), "args": self.args},  # args: the text with its source
        )


class RemoteEnvWarning(UserWarning):
    """The repository's code warns. Trust: category and text come from the worker.

    Attributes:
        label: The repository.
        category: The class, as the worker named it (``"DeprecationWarning"``).
        text: The warning.
    """

    def __init__(self, label: str, category: str, text: str) -> None:
        super().__init__(f"{label}: {category}: {continued(text)}")
        self.label = label
        self.category = category
        self.text = text

    def __reduce__(self) -> tuple[object, ...]:
        return RemoteEnvWarning, (self.label, self.category, self.text)


__all__ = [name for name in dir() if name.endswith(("Error", "Warning"))]

# A StopIteration would end a loop of the caller, and Python prints a SyntaxError without its text.
# A group needs exceptions, so _group makes its twin.
_WITHOUT_TWIN = (StopIteration, StopAsyncIteration, SyntaxError)
_BUILTINS: dict[str, type[Exception]] = {
    kind.__name__: kind  # OSError has several names
    for kind in vars(builtins).values()
    if isinstance(kind, type)
    and issubclass(kind, Exception)
    and not issubclass(kind, _WITHOUT_TWIN)
}
for _name in ("Exception", "ExceptionGroup"):
    _BUILTINS.pop(_name, None)


def _twin(ours: type[EnvHubError], kind: type[Exception]) -> Any:
    # str() must stay ours: KeyError would print a repr, OSError its errno pair.
    body = {
        "__doc__": f"The repository's code raised a {kind.__name__}.",
        "__module__": __name__,
        "__str__": Exception.__str__,
    }
    return type(f"{_PREFIXES[ours]}{kind.__name__}", (ours, kind), body)


_PREFIXES: dict[type[EnvHubError], str] = {RemoteEnvError: "Remote", LoadError: "Load"}


def _group(kind: Any) -> Any:
    """Make the twin of a group, which needs an exception: a ``RemoteEnvError`` with its text."""
    twin = _twin(RemoteEnvError, kind)
    twin.__new__ = lambda cls, *given: kind.__new__(cls, given[1], [RemoteEnvError(*given)])
    # a group's own message is read-only
    twin.message = property(
        lambda self: vars(self)["message"], lambda self, text: vars(self).update(message=text)
    )
    return twin


_TWINS = {(ours, name): _twin(ours, kind) for ours in _PREFIXES for name, kind in _BUILTINS.items()}
for _name in ("UnicodeDecodeError", "UnicodeEncodeError", "UnicodeTranslateError"):
    del _TWINS[LoadError, _name]  # their five arguments are not sent
if hasattr(builtins, "ExceptionGroup"):  # since Python 3.11
    _TWINS[RemoteEnvError, "ExceptionGroup"] = _group(builtins.ExceptionGroup)
globals().update({twin.__name__: twin for twin in _TWINS.values()})
_GYMNASIUM = "gymnasium.error"


@cache
def _gymnasiums() -> dict[str, Any]:
    """Make twins of Gymnasium's own errors, by full name."""
    module = sys.modules.get(_GYMNASIUM)  # imported if there is an environment
    kinds = {
        name: kind
        for name, kind in vars(module).items()
        if isinstance(kind, type) and issubclass(kind, Exception) and kind.__module__ == _GYMNASIUM
    }
    twins = {f"{_GYMNASIUM}.{name}": _twin(RemoteEnvError, kind) for name, kind in kinds.items()}
    for twin in twins.values():
        twin.name = ""  # Gymnasium's name of the pending call, which is not sent
    return twins


def _nearest(ours: type[EnvHubError], builtin: str) -> Any:
    """Return the twin of a builtin exception, or of its nearest ancestor with a twin."""
    kind = getattr(builtins, builtin, None)
    ancestors = kind.__mro__ if isinstance(kind, type) else ()
    candidates = (_TWINS.get((ours, ancestor.__name__)) for ancestor in ancestors)
    return next((twin for twin in candidates if twin is not None), ours)


def remote_error(builtin: str, type_name: str, message: str, traceback: str = "") -> RemoteEnvError:
    """Return the exception for a remote failure: a twin, or a plain ``RemoteEnvError``."""
    twin = _nearest(RemoteEnvError, builtin)
    for name in (builtin, type_name):
        if name.startswith(_GYMNASIUM) and _GYMNASIUM in sys.modules:
            twin = _gymnasiums().get(name, twin)
    error: RemoteEnvError = twin(type_name, message, traceback)
    return error


def load_error(builtin: str, message: str) -> LoadError:
    """Return the ``LoadError`` for a repository that raised a builtin while it was loaded."""
    error: LoadError = _nearest(LoadError, builtin)(message)
    return error


def known_reason(text: str) -> DependencyReason:
    """Return another process's reason for a ``DependencyError``; ``"other"`` if it is unknown."""
    return next((reason for reason in get_args(DependencyReason) if reason == text), "other")


def name_source(error: EnvHubError, label: str) -> None:
    """Prefix an error's text with its repository, commit and entry file, once."""
    text = str(error.args[0]) if error.args else ""
    if not text.startswith(label):
        error.args = (f"{label}: {text}", *error.args[1:])
    if isinstance(error, (WorkerDiedError, WorkerTimeoutError)):
        error.repository = label
