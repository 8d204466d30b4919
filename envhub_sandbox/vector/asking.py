"""Requests of a vector environment to its session: one at a time, none after ``close``.

Followed: ``gymnasium.vector.AsyncVectorEnv``, whose errors and words these are.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError

from envhub_sandbox.errors import RemoteEnvWarning, WorkerDiedError
from envhub_sandbox.session.exchange import Exchange, MessageFor
from envhub_sandbox.session.repository import Repository
from envhub_sandbox.transport.replies import typed
from envhub_sandbox.vector.sub_environment import MessageFor as OneMessageFor
from envhub_worker.protocol import messages as m

_SHOWN = 64
"""Characters of a name that are told of what is asked."""
P = ParamSpec("P")
T = TypeVar("T")


class Asking:
    """Asks for one environment.

    Args:
        exchange: Takes the requests.
        repository: Says how long answers may take, and of what the caller is to be warned.
        face: What the environment is called in errors.

    Attributes:
        closed: Whether ``close`` has been called.
        waiting: What was asked by an ``*_async``, and not waited for yet.
    """

    def __init__(self, exchange: Exchange, repository: Repository, face: str) -> None:
        self.closed = False
        self.waiting: str | None = None
        self._exchange = exchange
        self._timeouts = repository.timeouts
        self._repository = repository
        self._face = face

    def refuse_if_busy(self, name: str) -> None:
        """Another request has to wait.

        Raises:
            ClosedEnvironmentError: It is closed.
            AlreadyPendingCallError: Something is waited for.
        """
        self.refuse_if_closed()
        if self.waiting is not None:
            raise AlreadyPendingCallError(
                f"Calling `{name}` while waiting for a pending call to `{self.waiting}` to "
                "complete.",
                self.waiting,
            )

    def refuse_if_closed(self) -> None:
        """Nothing can be asked any more.

        Raises:
            ClosedEnvironmentError: It is closed.
        """
        if self.closed:
            raise ClosedEnvironmentError(
                f"Trying to operate on `{self._face}`, after a call to `close()`."
            )

    def end_wait(self, operation: str) -> None:
        """What an ``*_async`` asked for is waited for now.

        Raises:
            NoAsyncCallError: There was none.
        """
        self.refuse_if_closed()
        if self.waiting != operation:
            raise NoAsyncCallError(
                f"Calling `{operation}_wait` without any prior call to `{operation}_async`.",
                operation,
            )
        self.waiting = None

    def guarded(self, ask: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What that returns.

        Raises:
            ClosedEnvironmentError: A ``close`` in another thread has ended it under us.
        """
        try:
            answer = self.unwarned(ask, *args, **kwargs)
        except BaseException:
            self.tell_beside_an_error()
            raise
        self.tell()
        return answer

    def unwarned(self, ask: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """The same for what only sends: a filter that raised then would leave a reply owed."""
        try:
            return ask(*args, **kwargs)
        except WorkerDiedError:
            self.refuse_if_closed()
            raise

    def tell(self) -> None:
        """Warn of what the repository has warned of meanwhile.

        Never while a reply is handled: what the caller's filters raise is his.
        """
        if self._repository.heard.unshown:
            self._repository.tell()

    def tell_beside_an_error(self) -> None:
        """The same, where a filter that raises must not stand in for what is raised: a Ctrl-C."""
        with contextlib.suppress(RemoteEnvWarning):
            self.tell()

    def submit(
        self, operation: str, message_for: MessageFor, instead: MessageFor | None = None
    ) -> None:
        """Send a request to every shard; see ``Exchange.submit``."""
        self.unwarned(self._exchange.submit, operation, message_for, instead)

    def collect(self, timeout_s: float | None, kind: type[m.M]) -> list[m.M]:
        """The shards' replies, each of the kind that was asked for."""
        replies = self.guarded(self._exchange.collect, timeout_s)
        try:
            return [typed(reply, kind) for reply in replies]
        except BaseException:
            with self._exchange.handling():
                raise

    def ask(self, operation: str, message_for: MessageFor) -> list[m.Value]:
        """``submit`` and ``collect``."""
        self.refuse_if_busy(operation)
        self.submit(operation, message_for)
        return self.collect(self._timeouts.call_s, m.Value)

    def own(self, operation: str, kind: Callable[..., m.Message], *fields: object) -> m.Message:
        """Ask about what the repository's vector environment has of its own: one shard has it."""
        request, timeout_s = self._exchange.request, self._timeouts.call_s
        [reply] = self.guarded(
            request, operation, lambda number, _: kind(number, *fields), timeout_s
        )
        return reply

    def one(self, name: str, index: int, message: OneMessageFor) -> m.Message:
        """Ask about one sub-environment; other shards have nothing to say to it."""
        operation = f"envs[{index}].{name[:_SHOWN]}"  # which is no reset or step of all
        self.refuse_if_busy(operation)

        def message_for(number: int, bounds: tuple[int, int]) -> m.Message:
            start, stop = bounds
            return message(number, index - start if start <= index < stop else None)

        timeouts = {"reset": self._timeouts.reset_s, "step": self._timeouts.step_s}
        timeout_s = timeouts.get(name, self._timeouts.call_s)
        replies = self.guarded(self._exchange.request, operation, message_for, timeout_s)
        holds = (start <= index < stop for start, stop in self._exchange.results.bounds)
        return next(reply for reply, here in zip(replies, holds, strict=True) if here)
