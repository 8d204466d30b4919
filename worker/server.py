"""The worker server: ZeroMQ towards clients on one side, jails on the other.

Trusted code in one thread and one poll loop.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zmq

from envhub_worker import __version__
from envhub_worker.jails import Asker, Jails
from envhub_worker.lockdown.scratch import remove_tree
from envhub_worker.loop import Loop
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec import Buffer
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits


class Server:
    """Serves until ``stop()``, or until the client's process ends."""

    def __init__(
        self,
        endpoint: str,
        runtime_dir: Path,
        readable_roots: Sequence[str],
        client_pidfd: int | None = None,
        limits: WireLimits = DEFAULT_LIMITS,
        fd_path: Path | None = None,
    ) -> None:
        self._runtime_dir = runtime_dir
        self._limits = limits
        self._sessions: dict[bytes, bytes] = {}
        self._loop = Loop()
        self._context = zmq.Context()
        self._router = self._listen(endpoint)
        self._loop.watch(self._router, self._serve_clients)
        fd_path = fd_path or runtime_dir / "fds"
        self._jails = Jails(self._loop, self, runtime_dir, readable_roots, limits, fd_path)
        if client_pidfd is not None:
            self._loop.watch(client_pidfd, self.stop)

    def stop_on(self, *signals: int) -> None:
        """End the loop at these signals; to be called on the main thread."""
        self._loop.stop_on(*signals)

    def stop(self) -> None:
        """End the loop after the current round."""
        self._loop.stop()

    def _listen(self, endpoint: str) -> zmq.Socket[bytes]:
        router = self._context.socket(zmq.ROUTER)
        router.setsockopt(zmq.LINGER, 0)
        router.setsockopt(zmq.MAXMSGSIZE, self._limits.frame_bytes)
        router.setsockopt(zmq.RCVHWM, 64)
        router.setsockopt(zmq.ROUTER_HANDOVER, 0)
        router.bind(endpoint)
        return router

    def run(self) -> None:
        """Serve; on the way out every jail and zygote is gone."""
        try:
            self._loop.run()
        finally:
            self._shut_down()

    def _shut_down(self) -> None:
        self._jails.close()
        self._router.close()
        self._context.term()
        remove_tree(str(self._runtime_dir))  # its owner may not be there any more

    # --- clients -------------------------------------------------------------------------------

    def _serve_clients(self) -> None:
        while True:
            try:
                identity, *frames = self._router.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._serve(identity, frames)

    def _serve(self, identity: bytes, frames: list[bytes]) -> None:
        if not frames or len(frames[0]) > self._limits.header_bytes:
            return
        try:
            request_id, request = m.unpack(frames[:1], limits=self._limits)
        except ProtocolError:
            return  # not our protocol; there is no id to answer to
        asker = Asker(identity, request_id, self._sessions.get(identity, b""))
        try:
            self._dispatch(asker, request, frames[1:])
        except Exception as error:
            self.reply(asker, m.Refused("WorkerError", f"{type(error).__name__}: {error}", "", ""))

    def _dispatch(self, asker: Asker, request: m.Message, payload: list[bytes]) -> None:
        if isinstance(request, m.Hello):
            self._hello(asker, request)
        elif not asker.session:
            self.refuse(asker, "LocalProtocolError", "say Hello first")
        elif isinstance(request, m.Relay):
            self._jails.relay(asker, request, payload)
        else:
            handler = _HANDLERS.get(type(request))
            if handler is None:
                self.refuse(asker, "LocalProtocolError", f"{type(request).__name__} is no request")
            else:
                handler(self._jails, asker, request)

    def reply(self, asker: Asker, message: m.Message, payload: Sequence[Buffer] = ()) -> None:
        """Answer a request."""
        frames = [asker.identity, *m.pack(message, asker.request_id), *payload]
        self._router.send_multipart(frames, zmq.NOBLOCK, copy=False)

    def refuse(
        self, asker: Asker, error: str, message: str, layer: str = "", fix: str = ""
    ) -> None:
        """Answer that it is not done."""
        self.reply(asker, m.Refused(error, message, layer, fix))

    def _hello(self, asker: Asker, request: m.Hello) -> None:
        if not request.oldest <= m.VERSION <= request.newest:
            side = "client" if request.newest < m.VERSION else "worker"
            self.refuse(
                asker,
                "VersionMismatchError",
                f"the client speaks protocol {request.oldest} to {request.newest}, this worker "
                f"{m.VERSION}: upgrade the {side}",
            )
            return
        if not request.session:
            self.refuse(asker, "LocalProtocolError", "a session has a name")
            return
        self._sessions[asker.identity] = request.session
        self.reply(asker, m.Welcome(m.VERSION, __version__, os.getpid()))


_HANDLERS: dict[type[m.Message], Callable[[Jails, Asker, Any], None]] = {
    m.OpenJail: Jails.open,
    m.StartHosts: Jails.start_more,
    m.KeepJail: Jails.keep,
    m.CloseJail: Jails.close_jail,
    m.ReadOutput: Jails.read_output,
    m.FollowOutput: Jails.follow_output,
    m.GetStatus: Jails.status,
}
