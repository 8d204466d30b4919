"""The actor that runs on a node of a Ray cluster and starts a worker server beside it.

Ray imports this class by name, so the nodes need this package. The server has a pidfd of the
actor's process, and ends whenever that process ends. Ray kills an actor when its driver, its node
or the head has gone, but does not know the processes that the actor has started.

Ray carries only the client's public key to the actor, and JSON as bytes back, which needs no
pickle.
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
    """Starts one worker server on the actor's node; the server ends with the actor."""

    def __init__(self) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115, deleted when this process ends
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, client_key: str) -> bytes:
        """Start the server.
        ``client_key``: the public key of the server's only client, as text.

        Returns a JSON object: ``endpoint``, ``key`` (the server's public key), ``node`` (the node's
        id) and ``gpus`` (the indices of the GPUs that Ray has assigned); or ``error``, a text.
        """
        try:
            return json.dumps(self._started(client_key)).encode()
        except Exception as error:  # Ray would pickle an error that is raised here
            return json.dumps({"error": f"{type(error).__name__}: {error}"}).encode()

    def wait(self) -> bytes:
        """Wait until the server ends. Returns a JSON object: ``code``, the server's exit code, and
        ``log``, the end of its output.
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
            failure = "ended" if readable else f"was not ready after {STARTUP_S:.0f} s"
            self._process.kill()
            raise RuntimeError(f"the worker server {failure} ({sys.executable}):\n{self._tail()}")
        return {"endpoint": words[0], "key": words[1], "node": node, "gpus": gpus}

    def _executed(self, bind: str, client_key: str, ready: int) -> subprocess.Popen[bytes]:
        # a client that may start an actor may run any code here, so limits would protect nothing
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
                # this environment leaves out Ray's token
                env={**index.environment(), "OPENBLAS_NUM_THREADS": "1"},
                pass_fds=(ready, ourselves),
                start_new_session=True,
            )

    def _tail(self) -> str:
        size = os.fstat(self._log.fileno()).st_size
        data = os.pread(self._log.fileno(), _TAIL_BYTES, max(0, size - _TAIL_BYTES))
        return data.decode("utf-8", "replace")
