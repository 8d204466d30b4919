"""What a runner says in front of its replies: what was warned of, and what has changed.

Python's own filters of warnings come first, as in any other process. What is heard is shown, too,
as it was: it stands in what the jail prints. Followed: ``warnings.showwarning``.

An evaluation asks for its task's description after every step, which costs as much as the step. So
what is read again and again is looked at here after each request, and the client learns when it is
something else. Only what can be looked at without running any code of the repository is watched:
plain attributes with plain values, in a process with one thread that no signal runs anything in.
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
from envhub_worker.protocol.messages.prefix import (
    CHANGES,
    MAX_ATTRIBUTE,
    MAX_TEXT,
    SHARED_CATEGORY,
    WARNINGS,
    WATCHED_TYPES,
    Attribute,
    RemoteWarning,
)
from envhub_worker.protocol.text import printable
from envhub_worker.runner.sync_envs import SubEnvs

_MOST = 256
"""Different texts of one runner; further ones are only printed."""
_KEPT = 1024
"""Characters of a text."""
_COLORS = re.compile("\x1b\\[[0-9;]*m")
"""With which Gymnasium's logger surrounds what it says."""


class WarningLog:
    """What has been warned of. ``pending``, always the same list: what no reply has taken along."""

    def __init__(self) -> None:
        self.pending: list[RemoteWarning] = []
        self._heard: set[RemoteWarning] = set()

    def listen(self) -> None:
        """Hear whatever is shown from now on, in any thread."""
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
        """Sub-environments share what has this name in ``SHARED_STATE``."""
        self.pending.append((SHARED_CATEGORY, name))

    def _note(self, message: object, category: type) -> None:
        if len(self._heard) >= _MOST:
            return
        try:
            text = _COLORS.sub("", str(message)[:_KEPT])
            warning = (type_name(category), printable(text, _KEPT)[:MAX_TEXT])
        except Exception:  # it has no text
            return
        if warning not in self._heard:
            self._heard.add(warning)
            self.pending.append(warning)

    def in_front(self, frames: list[Any]) -> list[Buffer]:
        """A reply's frames, with what is pending in front of them."""
        if not self.pending or len(frames) >= DEFAULT_LIMITS.frames:
            return frames
        some = self.pending[: WARNINGS.most]
        del self.pending[: len(some)]
        return WARNINGS.put(some, frames)


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
    """Whether this process has no other threads of Python's, and handlers of no signals."""
    return not (_thread._count() or any(map(callable, map(_signal.getsignal, _SIGNALS))))


_Reading = tuple[Callable[[str], Any], Any]
"""How a sub-environment's attribute is read, and what it was."""


class Watches:
    """What is watched of the environments of one runner: readings of each attribute.
    ``changed``: what the client is to learn. Both are always the same dict.
    """

    def __init__(self, alone: Callable[[], bool] = is_alone) -> None:
        self._alone = alone
        self.readings: dict[Attribute, list[_Reading]] = {}
        self.changed: dict[Attribute, None] = {}

    def begin(self, number: int, env: Any, name: str, values: Any | None) -> bool:
        """Watch an attribute whose values have just been read; whether that is possible.
        ``values``: None where it is watched that no sub-environment has the attribute.
        """
        key = (number, name)
        self.readings.pop(key, None)
        self.changed.pop(key, None)
        if len(self.readings) >= CHANGES.most or not self._alone():
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
        """After a request: note what is something else than before, and watch it no more."""
        alone = self._alone()
        for key, readings in list(self.readings.items()):
            if not (alone and _are(key[1], readings)):
                del self.readings[key]
                self.changed[key] = None

    def forget(self, number: int) -> None:
        """The environment is closed."""
        for kept in (self.readings, self.changed):
            for key in [key for key in kept if key[0] == number]:
                del kept[key]

    def in_front(self, frames: list[Any]) -> list[Buffer]:
        """A reply's frames, with what has changed in front of them.

        A reply that has no room for it says by that alone that anything may have changed.
        """
        if not self.changed or len(frames) >= DEFAULT_LIMITS.frames:
            return frames
        keys = list(self.changed)[: CHANGES.most]
        for key in keys:
            del self.changed[key]
        return CHANGES.put(keys, frames)


def _can_be_watched(env: Any, name: str, values: Any) -> bool:
    if not isinstance(env, SubEnvs) or len(name) > MAX_ATTRIBUTE:
        return False
    if not all(type(value) in WATCHED_TYPES for value in values or ()):
        return False
    wanted = None if values is None else True
    try:
        return all(_is_plain(one, name) is wanted for one in env.envs)
    except Exception:  # of a kind that we do not know
        return False


def _are(name: str, readings: list[_Reading]) -> bool:
    """Whether everything is as it was."""
    try:
        for read, before in readings:
            now = read(name)
            if now is not before and (type(now) is not type(before) or now != before):
                return False
    except Exception:  # it is there no more
        return False
    return True


def _has(env: Any, name: str) -> bool:
    """Whether an environment or what it wraps has an attribute."""
    while not hasattr(env, name):
        if not isinstance(env, gym.Wrapper):
            return False
        env = env.env
    return True


def _is_plain(env: Any, name: str) -> bool | None:
    """Whether reading an attribute runs nothing but Gymnasium's own search through the wrappers.
    None: likewise, and the search is in vain.
    """
    while True:
        kind: Any = type(env)
        if kind.get_wrapper_attr not in _SEARCHES or _intercepts(kind):
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


def _intercepts(kind: Any) -> bool:
    """Whether a class has a say in what its attributes are."""
    own = kind.__getattribute__ is not object.__getattribute__
    return own or any("__getattr__" in vars(base) for base in kind.__mro__)
