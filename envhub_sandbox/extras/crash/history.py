"""What was asked of an environment since it was last seeded: enough to ask it again.

Kept in memory, bounded by count and by bytes, and read only when the environment's jail has died.
A step costs a copy of its actions. Of other requests the frames that were sent are copied: the
caller may change what they were made of afterwards.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from envhub_sandbox.extras.crash.recording import RecordedRequest, Recording, encoded
from envhub_sandbox.session.recorder import Crash, Recorder
from envhub_worker.protocol import messages as m

if TYPE_CHECKING:
    from envhub_sandbox.transport.jail import Request

HISTORY_BYTES = 8 << 20
"""Memory that the history of one environment takes at most."""
_ENTRY_BYTES = 150
_REQUEST_BYTES = 500
"""What Python's objects take beside the bytes of a step, and of another request."""
_MOST_LASTING = 256
_LASTING = (m.Call, m.SetAttr, m.CallOwn, m.CallOne)
_PASSING = frozenset({"reset", "step", "render"})
"""What is over with the next seed, also where one sub-environment does it alone."""
_SLICED = (m.Reset, m.SetAttr, m.SetRandom, m.GetOne, m.CallOne)
"""Each shard is sent another part of these."""


class History(Recorder):
    """Records the last requests of one environment.

    ``complete`` and ``seeded`` are as in ``Recording``.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._log: deque[Any] = deque()  # of steps the actions
        self.started()

    def started(self) -> None:
        """See ``Recorder``: requests to the former jail are forgotten."""
        self.complete = True
        self._begin(())

    def revived(self) -> None:
        """See ``Recorder``: a replay is not exact, as only some processes had earlier requests."""
        self.complete = self.complete and not self._log
        self._begin(())

    def _begin(self, entries: Sequence[RecordedRequest]) -> None:
        self.seeded = False
        self._log.clear()
        self._log.extend(entries)
        self._room = HISTORY_BYTES - sum(map(_size, entries))

    def step(self, actions: Any) -> None:
        """See ``Recorder``."""
        if type(actions) is not np.ndarray:
            self._add(_copied(actions))
            return
        self._log.append(actions.copy())
        self._room -= actions.nbytes + _ENTRY_BYTES
        if self._room < 0 or len(self._log) > self._limit:
            self._evict()

    def skip(self) -> None:
        """See ``Recorder``."""
        self.complete = False

    def requested(self, request: Request) -> None:
        """See ``Recorder``."""
        message = request.messages[0]
        if isinstance(message, m.Reset) and message.mask is None:
            self._reset([one.seeds for one in request.messages if isinstance(one, m.Reset)])
        passes = isinstance(message, m.CallOne) and message.name in _PASSING
        packed = _packed(request)._replace(lasts=isinstance(message, _LASTING) and not passes)
        self._add(packed)

    def _reset(self, seeds: list[Any]) -> None:
        """A reset of all: what it seeds does not depend on anything before, but for what lasts.

        Where none was seeded, nobody knows what came before it either.
        """
        each = chain.from_iterable(some if isinstance(some, list) else [some] for some in seeds)
        seeding = all(seed is not None for seed in each)
        if seeding or not self.seeded:
            lasting = {
                tuple(entry.frames): entry
                for entry in reversed(self._log)
                if isinstance(entry, RecordedRequest) and entry.lasts
            }
            self.complete = self.complete and len(lasting) <= _MOST_LASTING
            self._begin([*lasting.values()][_MOST_LASTING - 1 :: -1])
            self.seeded = seeding

    def _add(self, entry: Any) -> None:
        self._log.append(entry)
        self._room -= _size(entry)
        if self._room < 0 or len(self._log) > self._limit:
            self._evict()

    def _evict(self) -> None:
        """Forget the oldest requests."""
        while self._log and (self._room < 0 or len(self._log) > self._limit):
            self._room += _size(self._log.popleft())
            self.complete = False

    def recording(self) -> Recording:
        """What is kept, as it stands."""
        requests = [
            entry if isinstance(entry, RecordedRequest) else encoded(m.Step(0, entry))
            for entry in self._log
        ]
        complete = self.complete and all(request.exact for request in requests)
        return Recording(requests, complete, self.seeded)

    def of_part(self) -> Recorder:
        """See ``Recorder``."""
        return _PartHistory(self)

    def write(self, folder: Path, crash: Crash) -> Path | None:
        """See ``Recorder``."""
        from envhub_sandbox.extras.crash.bundle_writer import write_bundle

        return write_bundle(folder, crash, self.recording())


class _PartHistory(Recorder):
    """What one worker of a fleet adds to the history of the whole environment.

    The fleet records each request once, for all workers; a crash bundle of any of them has the
    whole.
    """

    def __init__(self, whole: History) -> None:
        self.requested = whole.requested  # type: ignore[method-assign]  # for this worker alone
        self.write = whole.write  # type: ignore[method-assign]
        # this worker is fresh, and the others may not be
        self.started = self.revived = whole.revived  # type: ignore[method-assign]


def _packed(request: Request) -> RecordedRequest:
    """What is kept of a request: what one shard was sent, where that is all of it."""
    first = request.messages[0]
    all_of_it = len(request.messages) == 1 and request.bounds[0][0] == 0
    is_whole = all_of_it or not isinstance(first, _SLICED)
    if request.plain and is_whole:
        return RecordedRequest(request.kept()[0], exact=True)
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
    if isinstance(value, RecordedRequest):
        return _REQUEST_BYTES + sum(map(len, value.frames))
    if type(value) is np.ndarray:
        return value.nbytes + _ENTRY_BYTES
    if type(value) is dict or isinstance(value, Mapping):
        return sum(map(_size, value.values())) + _ENTRY_BYTES
    if isinstance(value, (tuple, list)):
        return sum(map(_size, value)) + _ENTRY_BYTES
    return len(value) if isinstance(value, (str, bytes)) else _ENTRY_BYTES
