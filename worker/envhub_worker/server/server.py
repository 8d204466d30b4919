"""The worker server: ZeroMQ towards clients on one side, jails on the other.

Trusted code in one thread and one poll loop. Its gate knows who the clients are and what they may
do.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import zmq

from envhub_worker import __version__
from envhub_worker.lockdown.mechanisms.scratch import remove_tree
from envhub_worker.loop import Loop, has_message, send
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, LARGE_BYTES
from envhub_worker.protocol.messages import compression
from envhub_worker.protocol.text import shortage
from envhub_worker.server.gate import Gate, Incoming, LocalGate
from envhub_worker.server.sessions import Sessions
from envhub_worker.spawn.zygote_process import ZygoteProcess
from envhub_worker.supervisor.jails import Jails
from envhub_worker.supervisor.records import AnsweredError, Asker, RefusedError

_RCVHWM = 64
_ROUND = 64
"""Messages that are served before the jails have their turn."""
_NO_HELLO = (
    "a request before the Hello of its connection: a client that lost its connection, or whose "
    "server was started anew, says Hello on the new one and asks again"
)
_LAST_WORDS_MS = 500
"""How long to go on sending the last replies after a drain."""


class Server:
    """Serves until ``stop()``, or until the client's process ends."""

    def __init__(
        self,
        endpoint: str,
        runtime_dir: Path,
        readable_roots: Sequence[str],
        client_pidfd: int | None = None,
        fd_path: Path | None = None,
        gate: Gate | None = None,
        ahead: ZygoteProcess | None = None,
    ) -> None:
        self._runtime_dir = runtime_dir
        self._gate: Gate = gate or LocalGate()
        self._sessions = Sessions()
        self._loop = Loop(self._gate.witness.failed)
        # ROUTER takes its routing ids from rand(), which libzmq does not seed. A client that
        # predicts the next id can claim it, and libzmq then aborts the process.
        ctypes.CDLL(None).srand(int.from_bytes(os.urandom(4), "little"))
        self._context = zmq.Context()
        self._router = self._listen(endpoint)
        self._loop.watch_messages(self._router, self._serve_clients)
        self._jails = Jails(
            self._loop,
            self.reply,
            runtime_dir,
            readable_roots,
            fd_path or runtime_dir / "fds",
            ahead,
            self._gate.witness,
            local=isinstance(self._gate, LocalGate),
        )
        self._gate.begin(self._sessions, self._jails)
        self._loop.tick(self._tick)
        if client_pidfd is not None:
            self._loop.watch(client_pidfd, self.stop)

    @property
    def endpoint(self) -> str:
        """The endpoint that the server listens on, with its real port."""
        return str(self._router.get_string(zmq.LAST_ENDPOINT))

    def _tick(self) -> None:
        self._jails.look()
        self._gate.tick()
        if self._gate.drained():
            self.stop()

    def stop_on(self, *signals: int, gently: Sequence[int] = ()) -> None:
        """End the loop at these signals; to be called on the main thread.

        A signal of ``gently`` makes the gate refuse new work, and a second one ends the loop. If
        the gate does not wait for running work, the first one ends it.
        """
        self._loop.call_on(
            {**dict.fromkeys(signals, self.stop), **dict.fromkeys(gently, self._drain)}
        )

    def _drain(self) -> None:
        if not self._gate.drain():
            self.stop()

    def stop(self) -> None:
        """End the loop after the current round."""
        self._loop.stop()

    def _listen(self, endpoint: str) -> zmq.Socket[bytes]:
        router = self._context.socket(zmq.ROUTER)
        router.setsockopt(zmq.LINGER, 0)  # an end waits for no client
        # Checked before the allocation.
        router.setsockopt(zmq.MAXMSGSIZE, DEFAULT_LIMITS.frame_bytes)
        router.setsockopt(zmq.RCVHWM, _RCVHWM)  # of each client; then its own socket fills up
        router.setsockopt(zmq.ROUTER_HANDOVER, 0)  # nobody takes over another one's routing id
        router.setsockopt(zmq.IPV6, "[" in endpoint)
        # Before ``bind``: a peer that connects meanwhile would not be asked for its key.
        self._gate.secure(router, self._loop)
        router.bind(endpoint)
        return router

    def run(self) -> None:
        """Serve until the loop ends; then end every jail and zygote."""
        try:
            self._loop.run()
        finally:
            # In this order: strangers' processes end before anything else. The context ends only
            # when its sockets are closed.
            if self._gate.drained():  # clients that were refused last still get their replies
                self._router.setsockopt(zmq.LINGER, _LAST_WORDS_MS)
            self._jails.close()
            self._gate.close()
            self._router.close()
            self._context.term()
            remove_tree(str(self._runtime_dir))  # the client, which would do it, may have ended

    # --- clients -------------------------------------------------------------------------------

    def _serve_clients(self) -> None:
        for _ in range(_ROUND):
            try:
                arrived = self._gate.receive(self._router)
            except zmq.Again:  # what woke us was no message
                return
            self._serve(arrived)
            if not has_message(self._router):
                return

    def _serve(self, arrived: Incoming) -> None:
        identity, key, frames, _ = arrived
        if not frames:
            return
        session = self._sessions.find(identity, key)
        try:
            if len(frames) > 1 and self._compression(identity, key):
                frames[:] = compression.unpack_frames(frames, DEFAULT_LIMITS)
            number, request, payload = m.unpack_with_id(frames)
        except Exception as error:
            self._refuse_unread(identity, key, frames[0], error)
            return
        asker = Asker(identity, number, b"" if session is None else session.owner, key)
        try:
            reply = self._dispatch(asker, request, payload, arrived)
            if reply is not None:
                self.reply(asker, reply)
        except AnsweredError as early:
            self.reply(asker, early.reply)
        except Exception as error:
            if not isinstance(error, ProtocolError):  # which is an error of the client
                self._gate.witness.failed(error)
            text = f"{type(error).__name__} on the server: {error}"
            text = shortage(error, "on the server") or text
            self.reply(asker, RefusedError("WorkerError", text).reply)

    def _refuse_unread(self, identity: bytes, key: bytes, frame: Any, error: Exception) -> None:
        """Answer an unreadable request, if its id is readable."""
        number = m.id_of(frame)
        if number is None:
            return  # without an id no answer reaches a request
        text = str(error) if isinstance(error, ProtocolError) else type(error).__name__
        refused = RefusedError("LocalProtocolError", f"the request cannot be read: {text}")
        self.reply(Asker(identity, number, b"", key), refused.reply)

    def _dispatch(
        self, asker: Asker, request: m.Message, payload: list[Any], arrived: Incoming
    ) -> m.Message | None:
        """Returns the reply; None if it was sent or comes later. Raises ``AnsweredError``."""
        if isinstance(request, m.Hello):
            return self._hello(request, arrived)
        if not asker.session:
            raise RefusedError("HelloError", _NO_HELLO)
        request = self._gate.authorize(asker, request, payload)
        if isinstance(request, m.Relay):
            self._jails.relay(asker, request, payload)
            return None
        if handler := _HANDLERS.get(type(request)):
            return handler(self._jails, asker, request)
        if special := self._gate.handlers.get(type(request)):
            return special(asker, request, payload)
        raise RefusedError("LocalProtocolError", f"{type(request).__name__} is not a request")

    def reply(self, asker: Asker, message: m.Message, payload: Sequence[Buffer] = ()) -> None:
        """Answer a request."""
        self._gate.answered(asker, message)
        header, *buffers = (
            _packed_done(message.parts, message.dead)
            if type(message) is m.RelayDone
            else m.pack(message)
        )
        frames = m.with_id(header, asker.request_id, [*buffers, *payload])
        if len(frames) > 1 and (agreed := self._compression(asker.identity, asker.key)):
            frames = compression.pack_frames(frames, agreed)
        copy = sum(map(len, payload)) < LARGE_BYTES
        send(self._router, [asker.identity, *frames], copy=copy)

    def _compression(self, identity: bytes, key: bytes) -> str:
        return self._sessions.compression(identity, key) if self._gate.compresses else ""

    def _hello(self, request: m.Hello, arrived: Incoming) -> m.Message:
        if request.version != m.VERSION:
            raise RefusedError(
                "VersionMismatchError",
                f"the client speaks protocol {request.version}, this worker {m.VERSION}: install "
                "the same release of envhub-sandbox on both sides",
            )
        if not request.session:
            raise RefusedError("LocalProtocolError", "Hello has no name of a session")
        self._gate.greet(arrived, request.session)
        possible = compression.available() if self._gate.compresses else ()
        chosen = next((str(name) for name in request.compressions if name in possible), "")
        self._sessions.agree(arrived.identity, arrived.key, chosen)
        return m.Welcome(m.VERSION, __version__, os.getpid(), chosen, self._gate.idle_s)


@lru_cache(maxsize=64)  # of small numbers, that the server has counted
def _packed_done(parts: tuple[int, ...], dead: tuple[int, ...]) -> list[Buffer]:
    return m.pack(m.RelayDone(parts, dead))


_HANDLERS: dict[type[m.Message], Callable[[Jails, Asker, Any], m.Message | None]] = {
    m.OpenJail: Jails.open,
    m.StartRunners: Jails.start_more,
    m.KeepJail: Jails.keep,
    m.ShareSlabs: Jails.share,
    m.CloseJail: Jails.close_jail,
    m.CheckJail: Jails.check,
    m.FollowOutput: Jails.follow_output,
    m.GetStatus: Jails.status,
}
