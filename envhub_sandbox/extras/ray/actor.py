"""What runs on a node of a Ray cluster: an actor that starts a worker server beside it.

Ray finds it there by its name, so the nodes have this package installed. The server has a pidfd of
the actor's process and ends with it, whatever ended that: Ray kills an actor when its driver, its
node or the head has gone, and knows nothing of processes that the actor has started.

What goes through Ray is the client's public key on the way in, and JSON as bytes on the way out,
which Ray hands over without a pickle.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from typing import Any

from envhub_sandbox.extras.packages.resolution import index
from envhub_sandbox.sandboxes.process import worker_program
from envhub_sandbox.system.folders import cache_root
from envhub_sandbox.system.platform import pidfd, readable_within

STARTUP_S = 120.0
_LINE_BYTES = 4096
_TAIL_BYTES = 4000


class WorkerActor:
    """One worker server, on the node that this runs on; its life is the actor's."""

    def __init__(self) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115, it goes with this process
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, client_key: str) -> bytes:
        """Start the server.
        ``client_key``: the public key of its one client, as text.

        Returns a JSON object: ``endpoint``, ``key`` (the server's public one), ``node`` (its id)
        and ``gpus`` (those that Ray has assigned, by index); or ``error``, a text.
        """
        try:
            return json.dumps(self._started(client_key)).encode()
        except Exception as error:  # raised here, it would be a pickle there
            return json.dumps({"error": f"{type(error).__name__}: {error}"}).encode()

    def wait(self) -> bytes:
        """Wait until the server ends. Returns a JSON object: ``code``, its exit code, and ``log``,
        the end of what it has printed.
        """
        assert self._process is not None
        code = self._process.wait()
        return json.dumps({"code": code, "log": self._tail()}).encode()

    def _started(self, client_key: str) -> dict[str, Any]:
        import ray

        gpus = [int(index) for index in ray.get_gpu_ids()]
        node = ray.get_runtime_context().get_node_id()
        address = ray.util.get_node_ip_address()
        host = f"[{address}]" if ":" in address else address
        ready, ready_end = os.pipe()
        with open(ready, "rb") as answer:
            try:
                self._process = self._executed(f"tcp://{host}:*", client_key, ready_end)
            finally:
                os.close(ready_end)
            readable = readable_within(ready, STARTUP_S)
            words = answer.readline(_LINE_BYTES).decode().split() if readable else []
        if len(words) != 2:
            what = "ended" if readable else f"was not ready after {STARTUP_S:.0f} s"
            self._process.kill()
            raise RuntimeError(f"the worker server {what} ({sys.executable}):\n{self._tail()}")
        return {"endpoint": words[0], "key": words[1], "node": node, "gpus": gpus}

    def _executed(self, bind: str, client_key: str, ready: int) -> subprocess.Popen[bytes]:
        # whoever may start an actor may do anything here: there is nothing to forbid this client
        permitted = ("--weakest-profile=container", "--allow-network", "--allow-gpu")
        with pidfd() as ourselves:
            return subprocess.Popen(
                [
                    *worker_program("worker", "listen", "--bind", bind),
                    *("--only-client", client_key, "--state-dir", str(cache_root() / "ray")),
                    *(*permitted, "--dependencies", "--log-level=warning"),
                    *("--client-pidfd", str(ourselves), "--ready-fd", str(ready)),
                ],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                cwd="/",
                # without Ray's token, above all
                env={**index.environment(), "OPENBLAS_NUM_THREADS": "1"},
                pass_fds=(ready, ourselves),
                start_new_session=True,
            )

    def _tail(self) -> str:
        size = os.fstat(self._log.fileno()).st_size
        data = os.pread(self._log.fileno(), _TAIL_BYTES, max(0, size - _TAIL_BYTES))
        return data.decode("utf-8", "replace")
