"""The next tasks of a suite, started in the background while one plays.

An evaluation plays task after task. What the next one costs before its first ``reset`` returns (a
process, imports, the construction of its simulators) need not be waited for. Results do not depend
on it: what fails, or dies, before anybody has asked for it, is started again by whoever asks.
"""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain

from envhub_sandbox.log import WORKER
from envhub_sandbox.session.env_session import EnvSession

_GOING_S = 30.0
"""How long a jail that is given up may take to go: its ``close``, and its processes' ends."""


class Prewarming:
    """Starts the tasks after the one that was used last, and gives up what nobody came for.

    Thread-safe. Each task is started in a thread of its own, so that where starting takes longer
    than playing, the next is begun while somebody waits for the one before it.

    Args:
        suites: The environments of each suite, in order.
        count: How many tasks after the last one are started ahead, and so how many jails there
            are at most that nobody has used yet. None: one, once tasks are seen to be closed
            before the next is used; whoever uses just one task, or all at once, pays nothing.
    """

    def __init__(self, suites: Sequence[Sequence[EnvSession]], count: int | None) -> None:
        self._count = count
        # weak: an environment that nobody holds is closed
        self._suites = [[weakref.ref(env) for env in suite] for suite in suites]
        for ref in chain.from_iterable(self._suites):
            hash(ref)  # which it keeps: one that was never asked has none once its env has gone
        self._lock = threading.Lock()
        self._given_up = threading.Condition(self._lock)
        self._wanted: list[weakref.ref[EnvSession]] = []
        self._tried: set[weakref.ref[EnvSession]] = set()
        self._ahead: list[weakref.ref[EnvSession]] = []  # started here and not used yet
        self._giving_up = 0
        for suite in suites:
            for env in suite:
                env.head_start.on_first_use(partial(self._used, weakref.ref(env)), self.make_room)

    def make_room(self) -> bool:
        """Give up what nobody has used yet, since a server has no place left; whether there was."""
        with self._lock:
            self._wanted = []
            ahead, self._ahead = self._ahead, []
            going = self._giving_up > 0
        given_up = [_cool(env) for env in ahead]
        with self._lock:  # what others are giving up makes room, too, once it has gone
            self._given_up.wait_for(lambda: not self._giving_up, _GOING_S)
        return going or any(given_up)

    def _used(self, used: weakref.ref[EnvSession]) -> None:
        """A task has been asked something for the first time."""
        with self._lock:
            self._tried.add(used)
            self._ahead = [one for one in self._ahead if one != used]
            self._wanted = list(self._following(used))
            self._staff()

    def _staff(self) -> None:
        """A thread for each that is to be given up or started. The lock is held.

        Where the system has no thread left, whoever has asked for another task does not hear of it.
        """
        while (todo := self._next()) is not None:
            thread = threading.Thread(
                target=self._run, args=todo, name="envhub-prewarm", daemon=True
            )
            try:
                thread.start()
            except RuntimeError as error:
                WORKER.info("nothing is started ahead: %s", error)
                self._giving_up -= not todo[1]
                self._given_up.notify_all()
                return

    def _stale(self) -> list[weakref.ref[EnvSession]]:
        return [one for one in self._ahead if one not in self._wanted]

    def _untried(self) -> list[weakref.ref[EnvSession]]:
        return [one for one in self._wanted if one not in self._tried]

    def _following(self, used: weakref.ref[EnvSession]) -> Iterator[weakref.ref[EnvSession]]:
        suite = next(suite for suite in self._suites if used in suite)
        index = suite.index(used)
        count = self._count
        if count is None:
            count = 1 if index and _is_closed(suite[index - 1]) else 0
        left = [env for env in suite[index + 1 :] if env in self._ahead or env not in self._tried]
        yield from [env for env in left if not _is_closed(env)][:count]

    def _run(self, env: EnvSession, start: bool) -> None:
        try:
            with contextlib.suppress(Exception):  # whoever asks for it meets it, too
                env.head_start.warm_up() if start else env.head_start.cool_down()
        finally:
            if not start:
                with self._lock:
                    self._giving_up -= 1
                    self._staff()
                    self._given_up.notify_all()

    def _next(self) -> tuple[EnvSession, bool] | None:
        """What to give up (False) or start (True); first the former, which bounds their number."""
        for ref in self._stale():
            self._ahead.remove(ref)
            self._tried.discard(ref)
            env = ref()
            if env is not None:
                self._giving_up += 1
                return env, False
        for ref in [] if self._giving_up else self._untried():
            env = ref()
            self._tried.add(ref)
            if env is not None:
                self._ahead.append(ref)
                return env, True
        return None


def _is_closed(ref: weakref.ref[EnvSession]) -> bool:
    env = ref()
    return env is None or env.closed


def _cool(ref: weakref.ref[EnvSession]) -> bool:
    env = ref()
    return env is not None and env.head_start.cool_down()
