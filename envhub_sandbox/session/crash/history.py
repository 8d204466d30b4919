"""What was asked of an environment since it was last seeded: enough to ask it all again.

Kept in memory, bounded by count and by bytes, and read only when the environment's jail has died.
A step costs a copy of its actions as bytes. Of whatever else is asked the very frames that were
sent are copied: the caller may change what they were made of afterwards.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from envhub_sandbox.errors import EnvHubError
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES

if TYPE_CHECKING:
    from envhub_sandbox.transport.jail import Request

HISTORY_BYTES = 8 << 20
"""Memory that the history of one environment takes at most."""
_ENTRY_BYTES = 48
_REQUEST_BYTES = 500
"""What Python's objects take beside the bytes of a step, and of another request."""
_EVICTED = 64
_MOST_LASTING = 256
_LASTING = (m.Call, m.SetAttr, m.CallOwn, m.CallOne)
_PASSING = frozenset({"reset", "step", "render"})
"""What is over with the next seed, also where one sub-environment does it alone."""
_SLICED = (m.Reset, m.SetAttr, m.SetRandom, m.GetOne, m.CallOne)
"""Each shard is sent another part of these."""


@dataclass(frozen=True)
class RecordedRequest:
    """Any request but a step whose actions are one array.

    Attributes:
        operation: The message's name in lower case.
        exact: Whether these are its very values; what only pickle can carry is left out.
    """

    operation: str
    frames: list[bytes]
    exact: bool


@dataclass(frozen=True)
class Steps:
    """Steps in a row. ``actions`` is ``(steps, num_envs, *single_action_space.shape)``."""

    actions: Any


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A history, as it stood.

    Attributes:
        seeded: Whether every sub-environment was seeded, once, since the jail started.
        requests: Everything since the last reset that seeded all, or since the start; before it
            what lasts beyond a reset: calls, and attributes that were set.
        dropped: Requests that were forgotten in between, for their number or size, or that some
            sub-environments have lost by a transparent restart.
    """

    seeded: bool = False
    requests: tuple[Steps | RecordedRequest, ...] = ()
    dropped: int = 0

    @property
    def exact(self) -> bool:
        """Whether the same requests again are all there was."""
        plain = all(one.exact for one in self.requests if isinstance(one, RecordedRequest))
        return plain and not self.dropped


class History:
    """Records the requests of one environment. Not thread-safe: its owner holds a lock.
    ``limit``: how many requests are kept; 0 records nothing.
    ``step``: records a step, given its validated batch of actions.
    """

    def __init__(self, manifest: EnvManifest, limit: int) -> None:
        own = manifest.own_batch("action_space")
        space = manifest.single_action_space if own is None else own
        count = () if own is not None else (manifest.num_envs,)
        self._shape = (*count, *(space.shape or ()))
        is_flat = isinstance(space, ARRAY_SPACES)
        size = 8 * int(np.prod(self._shape, dtype=np.int64)) if is_flat else 0
        self._unit = _ENTRY_BYTES + size
        self._capacity = min(limit, max(1, HISTORY_BYTES // self._unit))
        self._log: deque[bytes | np.dtype[Any] | m.Step | RecordedRequest] = deque()
        self._append = self._log.append
        self._lasting: dict[object, RecordedRequest] = {}
        self.step: Callable[[Any], None] = lambda actions: None
        if limit:
            self.step = self._flat_step if is_flat else self._any_step
        self.started()

    def started(self) -> None:
        """A fresh jail: what was asked of another is of no concern."""
        self._lasting.clear()
        self._forgotten = 0
        self._seeded = False
        self._restart()

    def revived(self) -> None:
        """Some sub-environments are fresh: what follows is known again once all are seeded.

        The fresh ones have lost attributes that were set, the others have not.
        """
        self._forgotten += len(self._lasting)
        self._seeded = False
        self._restart()

    def _restart(self) -> None:
        self._log.clear()
        self._room = self._capacity
        self._dropped = 0
        self._dtype: np.dtype[Any] | None = None
        self._first_dtype: np.dtype[Any] | None = None

    def _flat_step(self, actions: Any) -> None:
        if type(actions) is list:
            self._any_step(actions)
            return
        if actions.dtype is not self._dtype:
            self._change(actions.dtype)
        self._append(actions.tobytes())
        self._room -= 1
        if self._room < 0:
            self._evict()

    def _change(self, dtype: np.dtype[Any]) -> None:
        if dtype != self._dtype:
            self._append(dtype)
            self._room -= 1
        self._dtype = dtype

    def _any_step(self, actions: Any) -> None:
        self._add(m.Step(0, _copied(actions)))

    def skip(self) -> None:
        """Something was asked of some sub-environments that is not kept."""
        self._dropped += 1

    def requested(self, request: Request) -> None:
        """Record another request, as it was sent."""
        if not self._capacity:
            return
        message = request.messages[0]
        if isinstance(message, m.Reset) and message.mask is None:
            self._reset([one.seeds for one in request.messages if isinstance(one, m.Reset)])
        made = _entry(request)
        passes = isinstance(message, m.CallOne) and message.name in _PASSING
        if isinstance(message, _LASTING) and not passes:
            self._keep_lasting(message, made)
        self._add(made)

    def _reset(self, seeds: list[Any]) -> None:
        """A reset of all: what it seeds does not depend on anything before, but for attributes."""
        each = [one for some in seeds for one in (some if isinstance(some, list) else [some])]
        seeding = all(seed is not None for seed in each)
        if seeding or not self._seeded:
            self._seeded = seeding
            self._restart()
            for entry in self._lasting.values():
                self._add(entry)

    def _keep_lasting(self, message: m.Message, made: RecordedRequest) -> None:
        name = message.name if isinstance(message, m.SetAttr) else None
        key: object = tuple(made.frames) if name is None else name
        self._lasting.pop(key, None)  # the last one counts, in its place
        self._lasting[key] = made
        if len(self._lasting) > _MOST_LASTING:
            del self._lasting[next(iter(self._lasting))]
            self._forgotten += 1

    def _add(self, entry: m.Step | RecordedRequest) -> None:
        self._append(entry)
        self._room -= self._units(entry)
        if self._room < 0:
            self._evict()

    def _units(self, entry: object) -> int:
        if isinstance(entry, RecordedRequest):
            return 1 + (_REQUEST_BYTES + sum(map(len, entry.frames))) // self._unit
        return 1 + _size(entry.actions) // self._unit if isinstance(entry, m.Step) else 1

    def _evict(self) -> None:
        """Forget the oldest requests, some at a time."""
        enough = max(1, self._capacity // _EVICTED)
        while self._room < enough and self._log:
            oldest = self._log.popleft()
            self._room += self._units(oldest)
            if isinstance(oldest, np.dtype):
                self._first_dtype = oldest
            else:
                self._dropped += 1
        if not self._log:
            self._dtype = None

    def recording(self) -> Recording:
        """What is kept, in order."""
        return Recording(
            seeded=self._seeded,
            requests=tuple(self._runs()),
            dropped=self._dropped + self._forgotten,
        )

    def _runs(self) -> list[Steps | RecordedRequest]:
        found: list[Steps | RecordedRequest] = []
        run: list[bytes] = []
        dtype = self._first_dtype
        for entry in [*self._log, None]:
            if isinstance(entry, bytes):
                run.append(entry)
                continue
            if run:
                actions = np.frombuffer(b"".join(run), dtype).reshape(len(run), *self._shape)
                found.append(Steps(actions))
                run = []
            if isinstance(entry, np.dtype):
                dtype = entry
            elif isinstance(entry, m.Step):
                found.append(encoded(entry))
            elif entry is not None:
                found.append(entry)
        return found


class PartHistory(History):
    """What one worker of a fleet adds to the history of the whole environment.

    The fleet records each request once, for all workers; a crash bundle of any of them has the
    whole. ``whole``: that history.
    """

    def __init__(self, manifest: EnvManifest, whole: History) -> None:
        self._whole = whole
        super().__init__(manifest, 0)

    def started(self) -> None:
        """This worker is fresh, and the others may not be."""
        super().started()
        self._whole.revived()

    def revived(self) -> None:
        """See ``History``."""
        self._whole.revived()

    def requested(self, request: Request) -> None:
        """A request that was for this worker alone."""
        self._whole.requested(request)

    def recording(self) -> Recording:
        """See ``History``: that of the whole."""
        return self._whole.recording()


def _entry(request: Request) -> RecordedRequest:
    """What is kept of a request: what one shard was sent, where that is all of it."""
    first = request.messages[0]
    all_of_it = len(request.messages) == 1 and request.bounds[0][0] == 0
    is_whole = all_of_it or not isinstance(first, _SLICED)
    if request.plain and is_whole:
        return RecordedRequest(_operation(first), request.kept()[0], exact=True)
    return encoded(_whole(request.messages, request.bounds))


def _whole(messages: Sequence[m.Message], bounds: Sequence[tuple[int, int]]) -> m.Message:
    """One message of those for all shards, to no environment in particular."""
    first: Any = messages[0]
    changes: dict[str, Any] = {"env": 0}
    others: Sequence[Any] = messages
    if isinstance(first, m.Reset):
        if isinstance(first.seeds, list):
            changes["seeds"] = [seed for one in others for seed in one.seeds]
        if first.mask is not None:
            changes["mask"] = np.concatenate([one.mask for one in others])
    if isinstance(first, m.SetAttr):
        changes["values"] = tuple(value for one in others for value in one.values)
    if isinstance(first, m.SetRandom):
        changes["states"] = tuple(state for one in others for state in one.states)
    if isinstance(first, (m.GetOne, m.CallOne)):
        places = [
            start + one.index
            for (start, _), one in zip(bounds, others, strict=True)
            if one.index is not None
        ]
        changes["index"] = places[0] if places else None
    made: m.Message = m.replace(first, **changes)
    return made


def encoded(message: m.Message) -> RecordedRequest:
    """A message as it can be kept: without anything pickled."""
    try:
        frames, exact = m.pack(message, pickler=_refuse), True
    except EnvHubError:
        frames, exact = _inert(message), False
    return RecordedRequest(_operation(message), [bytes(frame) for frame in frames], exact)


def _operation(message: m.Message) -> str:
    return type(message).__name__.lower()


def _inert(message: m.Message) -> list[Buffer]:
    """The same with descriptions in place of what only pickle could carry."""
    try:
        return m.pack(message)
    except EnvHubError:
        return m.pack(m.Done())


def _refuse(value: object) -> bytes:
    raise TypeError(f"{type(value).__name__} has no plain form")


def _copied(value: Any) -> Any:
    """Actions that their owner cannot change any more: arrays copied, containers rebuilt."""
    if type(value) is np.ndarray:
        return value.copy()
    if type(value) is dict or isinstance(value, Mapping):
        return {key: _copied(item) for key, item in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*map(_copied, value))
    if type(value) is list:
        return list(map(_copied, value))
    if isinstance(value, (tuple, list)):
        return tuple(map(_copied, value))
    return value


def _size(value: Any) -> int:
    if type(value) is np.ndarray:
        return int(value.nbytes) + _ENTRY_BYTES
    if type(value) is dict or isinstance(value, Mapping):
        return sum(map(_size, value.values())) + _ENTRY_BYTES
    if isinstance(value, (tuple, list)):
        return sum(map(_size, value)) + _ENTRY_BYTES
    return len(value) if isinstance(value, (str, bytes)) else _ENTRY_BYTES
