"""The calls to Ray: connects a process, starts an actor, reads its answers, and reports its end.

Trust: a node belongs to its operator. An actor's answers are plain data, which this module checks.
Ray's own texts are only shown.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import importlib.util
import json
import platform
import threading
from collections.abc import Callable, Mapping
from typing import Any

from envhub_sandbox.errors import (
    PolicyError,
    SandboxUnavailableError,
    ServerBusyError,
    WorkerStartupError,
)
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.log import WORKER, warn_caller
from envhub_worker.protocol.text import printable

_MOST_BYTES = 65_536
_SHOWN_CHARS = 2_000
_GUESSES = "Some common causes include"
"""Ray's errors list general causes from these words on, which end_text leaves out."""
_connecting = threading.RLock()  # interruption.md, rule 12


def check_installed() -> None:
    """Raise ``SandboxUnavailableError`` if this interpreter has no Ray."""
    if importlib.util.find_spec("ray") is None:
        raise SandboxUnavailableError(
            f"{option_name('sandbox', 'ray')} needs Ray, which this interpreter does not have: "
            "pip install 'envhub-sandbox[ray]'"
        )


def name(address: str) -> str:
    """Return a text that names the cluster and this Python version; connects to nothing."""
    import ray

    if ray.is_initialized():
        address = str(ray.get_runtime_context().gcs_address)
    return f"Ray at {address or 'auto'}, Python {platform.python_version()}"


def connect(address: str = "") -> None:
    """Connect this process to a Ray cluster, unless it is connected.
    ``address``: as in ``ray.init``. If it is empty, the process connects to a running cluster; if
    there is none, it starts a local one and warns.
    Raises ``PolicyError``: the process is connected to another cluster;
    ``SandboxUnavailableError``: Ray does not start, or there is no cluster at the address.
    """
    check_installed()
    import ray

    with _connecting:
        if ray.is_initialized():
            connected = str(ray.get_runtime_context().gcs_address)
            if address not in ("", "auto", "local", connected) and "://" not in address:
                raise PolicyError(
                    f"RaySandbox(address={address!r}): this process is connected to the cluster at "
                    f"{connected}. Leave the address out, or call ray.shutdown() first"
                )
            return
        try:
            is_local = _started_here(address)
        except (ConnectionError, OSError, RuntimeError, ValueError) as error:
            text = printable(str(error), _SHOWN_CHARS)
            at_address = f" at {address!r}" if address else ""
            raise SandboxUnavailableError(f"Ray cannot be used{at_address}: {text}") from error
        if is_local:
            cpus = ray.cluster_resources().get("CPU", 0)
            started = f"ray.init was not called: a local Ray with {cpus:g} CPUs was started"
            warn_caller(started, RuntimeWarning)


def _started_here(address: str) -> bool:
    import ray

    try:
        ray.init(address=address or "auto")
    except ConnectionError:
        if address:
            raise
        ray.init(address="local", include_dashboard=False)
        return True
    return False


def job() -> str | None:
    """Return the id of this process's job, which each ``ray.init`` makes anew; None without one."""
    import ray

    return str(ray.get_runtime_context().get_job_id()) if ray.is_initialized() else None


class PlacedActor:
    """An actor with a worker server, started by this process.
    ``options``: arguments of ``ActorClass.options``, by which Ray places the actor.
    """

    def __init__(self, options: Mapping[str, Any]) -> None:
        import ray

        # late, because the actor's module is for nodes, which run Linux; a client may run another
        from envhub_sandbox.extras.ray.actor import WorkerActor

        self._job = job()
        # no restart by Ray, whose new server would have other keys: the client starts a new one
        remote = ray.remote(max_restarts=0, max_task_retries=0)(WorkerActor)
        try:
            self._handle = remote.options(**options).remote()
        except (TypeError, ValueError) as error:
            raise PolicyError(f"RaySandbox: {error}") from error
        self._end: concurrent.futures.Future[Any] = concurrent.futures.Future()
        self._called: Any = None
        self._ended: Callable[[], object] = lambda: None

    def start(self, client_key: str, within_s: float) -> dict[str, Any]:
        """Have the actor start its server, once Ray has placed the actor; returns its answer.
        Raises ``ServerBusyError``: Ray finds no node in time; ``SandboxUnavailableError``: a node
        cannot make the ``runtime_env``; ``WorkerStartupError``: the actor or the server has ended.
        """
        import ray

        try:
            answer = ray.get(self._handle.start.remote(client_key), timeout=within_s)
        except ray.exceptions.GetTimeoutError:
            raise _busy(within_s) from None
        except ray.exceptions.RuntimeEnvSetupError as error:
            text = printable(str(error), _SHOWN_CHARS)
            raise SandboxUnavailableError(f"Ray cannot make the runtime_env: {text}") from error
        except ray.exceptions.RayError as error:
            raise _not_started(error) from error
        reply = read_answer(answer)
        if "error" in reply:
            text = printable(str(reply["error"]), _SHOWN_CHARS)
            raise WorkerStartupError(f"a worker server on a node of Ray: {text}")
        return reply

    def watch(self, ended: Callable[[], object]) -> None:
        """Call ``ended``, in any thread, once the server or the actor has ended."""
        self._ended = ended
        self._ask()

    def _ask(self) -> None:
        self._called = self._handle.wait.remote()
        self._called.future().add_done_callback(self._answered)

    def _answered(self, answer: concurrent.futures.Future[Any]) -> None:
        import ray

        if isinstance(answer.exception(), ray.exceptions.ActorUnavailableError):
            with contextlib.suppress(Exception):  # raised if Ray has been shut down
                self._ask()  # the actor may still live: wait again
                return
        self._end.set_result(answer)
        self._ended()

    @property
    def runs(self) -> bool:
        """Whether Ray has not reported the end of the server or the actor."""
        return not self._end.done() and job() == self._job

    def end_text(self, wait_s: float) -> str:
        """Describe the end in Ray's words or the server's; waits at most ``wait_s`` for them."""
        if job() != self._job:
            return "ray.shutdown() was called in this process, which ends its actors"
        try:
            answer = self._end.result(wait_s)
        except (concurrent.futures.TimeoutError, TimeoutError):
            return "Ray has not said that it ended"
        error = answer.exception()
        if error is not None:
            return f"Ray says: {_one_line(str(error).partition(_GUESSES)[0])}"
        try:
            reply = read_answer(answer.result())
        except WorkerStartupError as error:  # the caller of this reports another error
            return str(error)
        code, log = _one_line(str(reply.get("code"))), _one_line(str(reply.get("log")))
        return f"it ended with {code}: {log}"

    def kill(self) -> None:
        """End the actor, and with it the server. Idempotent; no effect after ``ray.shutdown``."""
        import ray

        if job() == self._job:
            ray.kill(self._handle, no_restart=True)


def read_answer(answer: object) -> dict[str, Any]:
    """Parse an actor's answer. Trust: input from a node. Raises ``WorkerStartupError``: invalid."""
    try:
        if type(answer) is bytes and len(answer) <= _MOST_BYTES:
            document = json.loads(answer)
            if type(document) is dict:
                return document
    except (ValueError, RecursionError):
        pass
    raise WorkerStartupError("an actor on a node of Ray gave an answer of another program")


def _one_line(text: str) -> str:
    return printable(" ".join(text.split()), _SHOWN_CHARS)


def _busy(within_s: float) -> ServerBusyError:
    import ray

    free = {resource: round(count, 2) for resource, count in ray.available_resources().items()}
    shown = {
        resource: free[resource]
        for resource in sorted(free)
        if not resource.startswith(("node:", "object_"))
    }
    return ServerBusyError(
        f"Ray has started no worker server within {within_s:g} s, and {shown} are free in the "
        f"whole cluster. Close environments, ask for less in RaySandbox(num_cpus=..., "
        f"resources=...) or by a smaller {option_name('num_workers')}, add nodes, or wait for "
        "longer with placement_s",
        quota="cluster",
    )


def _not_started(error: Exception) -> WorkerStartupError:
    words = _one_line(str(error))
    WORKER.debug("no actor: %s", words)
    if "envhub_sandbox" in words and "ModuleNotFoundError" in words:
        return WorkerStartupError(
            "a node of Ray has no envhub-sandbox. Install this release in the nodes' image, or "
            f"pass RaySandbox(runtime_env={{'pip': ['envhub-sandbox[ray]']}}). Ray says: {words}"
        )
    return WorkerStartupError(f"Ray could not start a worker server: {words}")
