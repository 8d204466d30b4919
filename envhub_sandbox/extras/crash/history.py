"""Records an environment's requests since its last seed: enough to repeat them.

The record is in memory, bounded by count and by bytes, and read only if the environment's jail
dies. A step costs a copy of its actions. For other requests the sent frames are copied, since the
caller may change the arguments afterwards.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from envhub_sandbox.errors import EnvHubError
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
_LASTING = (m.Call, m.SetAttr, m.CallOne)
_PASSING = frozenset({"reset", "step", "render"})
"""What is over with the next seed, also where one sub-environment does it alone."""
_FIXED = frozenset({bool, int, float, complex, str, bytes, type(None)})
_SLICED: dict[type[m.Message], tuple[str, ...]] = {
    m.Reset: ("seeds", "mask"),
    m.SetAttr: ("values",),
    m.SetRandom: ("states",),
    m.GetOne: (),
    m.CallOne: (),
}
"""Messages of which each shard is sent its own part, and the fields to join again."""


class RecordedRequest(NamedTuple):
    """A recorded request: frames without pickles; ``lasts``: whether a reset keeps it."""

    frames: list[bytes]
    lasts: bool = False


class History(Recorder):
    """Records the last requests of one environment."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        # A step is kept as a copy of its actions. Only a death packs it: packing takes longer than
        # many steps.
        self._log: deque[Any] = deque()
        self.started()

    def started(self) -> None:
        """Forget the requests to the previous jail: see ``Recorder``."""
        self._begin(())

    def _begin(self, entries: Sequence[RecordedRequest]) -> None:
        self._log.clear()
        self._room = HISTORY_BYTES
        for entry in entries:
            self._add(entry)

    def step(self, actions: Any) -> None:
        """See ``Recorder``."""
        try:
            self._add(_copied(actions))
        except TypeError:
            self._add(RecordedRequest(encoded(m.Step(0, actions))))

    def requested(self, request: Request) -> None:
        """See ``Recorder``. What a reset of all seeds does not depend on what was asked before it,
        but for calls and attributes, which are asked again first, equal ones once.
        """
        message = request.messages[0]
        if isinstance(message, m.Reset) and message.mask is None and _seeds_all(request.messages):
            lasting = {
                tuple(entry.frames): entry
                for entry in reversed(self._log)
                if isinstance(entry, RecordedRequest) and entry.lasts
            }
            self._begin([*lasting.values()][_MOST_LASTING - 1 :: -1])
        passes = isinstance(message, m.CallOne) and message.name in _PASSING
        self._add(RecordedRequest(_frames(request), isinstance(message, _LASTING) and not passes))

    def _add(self, entry: Any) -> None:
        self._log.append(entry)
        self._room -= _size(entry)
        while self._log and (self._room < 0 or len(self._log) > self._limit):
            self._room += _size(self._log.popleft())

    def recording(self) -> list[list[bytes]]:
        """Returns the frames of the recorded requests, in order."""
        return [
            entry.frames if isinstance(entry, RecordedRequest) else encoded(m.Step(0, entry))
            for entry in self._log
        ]

    def of_part(self) -> Recorder:
        """See ``Recorder``. A fleet records each step itself, and any bundle has all workers'."""
        part: Any = Recorder()
        part.started, part.requested, part.write = self.started, self.requested, self.write
        return cast("Recorder", part)

    def write(self, folder: Path, crash: Crash) -> Path | None:
        """See ``Recorder``."""
        from envhub_sandbox.extras.crash.bundle_writer import write_bundle

        return write_bundle(folder, crash, self.recording())


def encoded(message: m.Message) -> list[bytes]:
    """Encodes a message, with descriptions in place of values that would need pickle."""
    try:
        return [*map(bytes, m.pack(message))]
    except EnvHubError:
        return [*map(bytes, m.pack(m.Done()))]


def _seeds_all(resets: Sequence[Any]) -> bool:
    seeds = [reset.seeds if isinstance(reset.seeds, list) else [reset.seeds] for reset in resets]
    return all(seed is not None for each in seeds for seed in each)


def _frames(request: Request) -> list[bytes]:
    """What is kept of a request: what one shard was sent, where that is all of it."""
    first = request.messages[0]
    all_of_it = len(request.messages) == 1 and request.bounds[0][0] == 0
    if request.plain and (all_of_it or type(first) not in _SLICED):
        return request.kept()[0]
    return encoded(_whole(request.messages, request.bounds))


def _whole(messages: Sequence[Any], bounds: Sequence[tuple[int, int]]) -> m.Message:
    """One message of those for all shards, to no environment in particular."""
    first = messages[0]
    changes: dict[str, Any] = {"env": 0}
    for name in _SLICED.get(type(first), ()):
        changes[name] = _joined([getattr(message, name) for message in messages])
    if isinstance(first, (m.GetOne, m.CallOne)):
        pairs = zip(bounds, messages, strict=True)
        rows = [start + part.index for (start, _), part in pairs if part.index is not None]
        changes["index"] = rows[0] if rows else None
    whole: m.Message = m.replace(first, **changes)
    return whole


def _joined(slices: Sequence[Any]) -> Any:
    if isinstance(slices[0], np.ndarray):
        return np.concatenate(slices)
    is_sequence = isinstance(slices[0], (list, tuple))
    return type(slices[0])(item for part in slices for item in part) if is_sequence else slices[0]


def _copied(actions: Any) -> Any:
    """Actions that their owner cannot change any more: arrays copied, containers rebuilt.
    Raises ``TypeError``: of a tensor, for instance, neither that nor the size is known.
    """
    if type(actions) is np.ndarray and not actions.dtype.hasobject:
        return actions.copy()
    if isinstance(actions, Mapping):
        return {key: _copied(item) for key, item in actions.items()}
    if isinstance(actions, (tuple, list)):
        return [*map(_copied, actions)] if type(actions) is list else tuple(map(_copied, actions))
    if type(actions) not in _FIXED and not isinstance(actions, (np.number, np.bool_)):
        raise TypeError
    return actions


def _size(entry: Any) -> int:
    if type(entry) is np.ndarray:
        return entry.nbytes + _ENTRY_BYTES
    if isinstance(entry, RecordedRequest):
        return _REQUEST_BYTES + sum(map(len, entry.frames))
    if isinstance(entry, (tuple, list, Mapping)):
        values = entry.values() if isinstance(entry, Mapping) else entry
        return _ENTRY_BYTES + sum(map(_size, values))
    return _ENTRY_BYTES + (len(entry) if isinstance(entry, (str, bytes)) else 0)
