"""Prefixes of a runner's replies: warnings, and changes of watched attributes.

Python's own warning filters apply first, as in any other process. The runner also shows each
warning as usual, so the jail's output has it. Followed: ``warnings.showwarning``.

An evaluation reads its task's description after every step, and a request for it costs as much as
the step. So the runner compares such attributes after each request and tells the client which have
changed. It watches only attributes that it can read without running the repository's code: plain
attributes with plain values, in a process with one thread and no signal handlers.
Followed: ``gymnasium.Wrapper.get_wrapper_attr``.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]
import _thread
import re
import signal
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym

from envhub_worker.protocol.codec.inert import type_name
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.messages import prefix
from envhub_worker.protocol.text import printable
from envhub_worker.runner.sync_envs import SubEnvs

_MOST = 256
"""Different texts of one runner; further ones are only printed."""
_KEPT = 1024
"""Characters of a text."""
_COLORS = re.compile("\x1b\\[[0-9;]*m")
"""With which Gymnasium's logger surrounds what it says."""


class WarningLog:
    """Collects warnings. ``pending``, always the same list: those that no reply has carried yet."""

    def __init__(self) -> None:
        self.pending: list[prefix.RemoteWarning] = []
        self._heard: set[prefix.RemoteWarning] = set()  # each goes out once

    def listen(self) -> None:
        """Collect every warning that any thread shows from now on."""
        show = warnings.showwarning

        def hear(
            message: Any,
            category: Any,
            filename: str,
            lineno: int,
            file: Any = None,
            line: Any = None,
        ) -> None:
            if file is None:
                self._note(message, category)
            show(message, category, filename, lineno, file, line)

        warnings.showwarning = hear

    def note_shared(self, name: str) -> None:
        """Warn that sub-environments share state, which has this name in ``SHARED_STATE``."""
        self.pending.append((prefix.SHARED_CATEGORY, name))

    def _note(self, message: object, category: type) -> None:
        if len(self._heard) >= _MOST:
            return
        try:
            text = _COLORS.sub("", str(message)[:_KEPT])
            warning = (type_name(category), printable(text, _KEPT)[: prefix.MAX_TEXT])
        except Exception:  # it has no text
            return
        if warning not in self._heard:
            self._heard.add(warning)
            self.pending.append(warning)

    def in_front(self, frames: list[Any]) -> list[Buffer]:
        """Puts the pending warnings in front of a reply's frames."""
        if not self.pending or len(frames) >= DEFAULT_LIMITS.frames:
            return frames
        some = self.pending[: prefix.WARNINGS.most]
        del self.pending[: len(some)]
        return prefix.WARNINGS.put(some, frames)


_SEARCHES: frozenset[Any] = frozenset(
    getattr(kind, "get_wrapper_attr", None) for kind in (gym.Env, gym.Wrapper)
)
"""Gymnasium's own."""


_SIGNALS = tuple(
    signal.Signals[f"SIG{name}"].value
    for name in ("HUP", "USR1", "USR2", "ALRM", "TERM", "CHLD", "URG", "VTALRM", "PROF", "IO")
)
"""What timers, children and others interrupt a process with that waits for its next request."""


def is_alone() -> bool:
    """Whether this process has only one Python thread and no signal handlers."""
    return not (_thread._count() or any(map(callable, map(_signal.getsignal, _SIGNALS))))


_Reading = tuple[Callable[[str], Any], Any]
"""How a sub-environment's attribute is read, and what it was."""


class Watches:
    """Watched attributes of one runner's environments.
    ``readings``: the values of each; ``changed``: changes that the client does not know yet. Both
    are always the same dict.
    """

    def __init__(self, alone: Callable[[], bool] = is_alone) -> None:
        self._alone = alone
        self.readings: dict[prefix.Attribute, list[_Reading]] = {}
        self.changed: dict[prefix.Attribute, None] = {}

    def begin(self, number: int, env: Any, name: str, values: Any | None) -> bool:
        """Watch an attribute whose values were just read; returns whether that is possible.
        ``values``: None if no sub-environment has the attribute, which is watched, too.
        """
        key = (number, name)
        self.readings.pop(key, None)
        self.changed.pop(key, None)
        if len(self.readings) >= prefix.CHANGES.most or not self._alone():
            return False
        if not _can_be_watched(env, name, values):
            return False
        if values is None:
            self.readings[key] = [(partial(_has, one), False) for one in env.envs]
        else:
            reads = [one.get_wrapper_attr for one in env.envs]
            self.readings[key] = list(zip(reads, values, strict=True))
        return True

    def look(self) -> None:
        """Note which attributes the last request has changed, and stop watching them."""
        alone = self._alone()
        for key, readings in list(self.readings.items()):
            if not (alone and _are(key[1], readings)):
                del self.readings[key]
                self.changed[key] = None

    def forget(self, number: int) -> None:
        """Forget an environment, which is closed."""
        for kept in (self.readings, self.changed):
            for key in [key for key in kept if key[0] == number]:
                del kept[key]

    def in_front(self, frames: list[Any]) -> list[Buffer]:
        """Puts the changes in front of a reply's frames.

        A reply that already has the maximum number of frames has no room for them. The client takes
        such a reply to mean that anything may have changed.
        """
        if not self.changed or len(frames) >= DEFAULT_LIMITS.frames:
            return frames
        keys = list(self.changed)[: prefix.CHANGES.most]
        for key in keys:
            del self.changed[key]
        return prefix.CHANGES.put(keys, frames)


def _can_be_watched(env: Any, name: str, values: Any) -> bool:
    if not isinstance(env, SubEnvs) or len(name) > prefix.MAX_ATTRIBUTE:
        return False
    if not all(type(value) in prefix.WATCHED_TYPES for value in values or ()):
        return False
    wanted = None if values is None else True
    try:
        return all(_is_plain(one, name) is wanted for one in env.envs)
    except Exception:  # of a kind that we do not know
        return False


def _are(name: str, readings: list[_Reading]) -> bool:
    """Whether all readings still hold."""
    try:
        for read, before in readings:
            now = read(name)
            if now is not before and (type(now) is not type(before) or now != before):
                return False
    except Exception:  # it is there no more
        return False
    return True


def _has(env: Any, name: str) -> bool:
    """Whether an environment or one that it wraps has an attribute."""
    while not hasattr(env, name):
        if not isinstance(env, gym.Wrapper):
            return False
        env = env.env
    return True


def _is_plain(env: Any, name: str) -> bool | None:
    """Whether reading an attribute runs only Gymnasium's own search through the wrappers.
    None: only that search runs, and it finds nothing.
    """
    while True:
        kind: Any = type(env)
        if kind.get_wrapper_attr not in _SEARCHES:
            return False
        intercepts = any("__getattr__" in vars(base) for base in kind.__mro__)
        if intercepts or kind.__getattribute__ is not object.__getattribute__:
            return False
        values = [vars(base)[name] for base in kind.__mro__ if name in vars(base)]
        if values:  # of the class: a property, a method, or a value
            return not hasattr(type(values[0]), "__get__")
        own = vars(env)
        if name in own:
            return True
        if not isinstance(env, gym.Wrapper):
            return None
        env = own["env"]
