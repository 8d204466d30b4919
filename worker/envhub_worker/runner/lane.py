"""The jail's end of the fast lane: at a ring of its doorbell it steps from one slab into another.

Our doorbell is the other end of the client's socket; the client's doorbell is an eventfd. Each read
and write is one whole word. Followed: ``eventfd(2)``, ``unix(7)``, ``memfd_create(2)``. The request
slab is mapped read-only (the client has sealed it against our writes); we write the reply slab.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import struct
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from itertools import chain
from time import perf_counter_ns
from typing import Any

import gymnasium as gym
import numpy as np

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.arrays import NUMBERS
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.messages.forms import IrregularError
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.columns import StepColumns
from envhub_worker.protocol.shared_memory.packets import array_start, read_packet, write_packet
from envhub_worker.protocol.spaces import batches
from envhub_worker.runner.prefixes import Watches
from envhub_worker.runner.sync_envs import Pairs, SubEnvs

_RING = (1).to_bytes(8, "little")
_MOST_AWAKE = 256
"""Requests in a row of a client that is always quick, between two looks at the server's."""
_SELDOM = 64
"""Steps, at most, from one offer of columns that were of no use to the next."""


class Lane:
    """Serves one environment's requests, each of which is a message, steps included.

    Args:
        attach: The request that brought the slabs: rows, number of slots.
        space: The space of one sub-environment's observations, if steps are messages.
        step: Steps the environment with a batch of actions.
        complete: Makes the fields of ``StepDone`` of what ``step`` returned.
        pack: Encodes a message with infos.
        fds: Request slab, reply slab, observation slab, our doorbell, the client's doorbell. The
            lane owns them.
        read: Decodes the frames of a request.
        answer: Encodes the answer to any other request.
        raised: Makes the message for an exception.
        warned: The repository's warnings that no reply has carried yet. While there are any, the
            client fetches answers through the server, which puts them in front.
        watches: The attributes that the client watches; their changes go the same way.

    Attributes:
        unsent: The frames of the last answer if the client must fetch it.
        was_awake: Whether it has waited awake, so that its client may not have rung.
    """

    def __init__(
        self,
        attach: m.Attach,
        space: gym.Space[Any] | None,
        step: Callable[[Any], Any],
        complete: Callable[[Any], Sequence[Any]],
        pack: Callable[[m.Message], list[Any]],
        fds: list[int],
        read: Callable[[list[Any]], m.Message],
        answer: Callable[[m.Message], list[Any]],
        raised: Callable[[BaseException, str], m.RaisedException],
        warned: Sequence[Any],
        watches: Watches,
    ) -> None:
        self._do_step, self._complete, self._pack = step, complete, pack
        self.number = attach.env
        self.unsent: list[Any] = []
        self.was_awake = False
        self._read, self._answer = read, answer
        self._raised = raised
        self._warned = warned
        self._watches = watches
        self._watched, self._changed = watches.readings, watches.changed
        *slab_fds, self.bell, self._client_bell = fds
        request, reply, observations = [os.fstat(fd).st_size for fd in slab_fds]
        self._request = mmap.mmap(slab_fds[0], request, prot=mmap.PROT_READ)
        self._reply = mmap.mmap(slab_fds[1], reply)
        self._observations = mmap.mmap(slab_fds[2], observations)
        for fd in slab_fds:
            os.close(fd)
        os.set_blocking(self.bell, False)
        self._slot_bytes = observations // attach.slots
        self._message = slabs.HEADER_BYTES  # offset of a message in the request slab
        self._requested = memoryview(self._request)  # frames of messages are views of it
        self._asked = slabs.words(self._request)  # the header that the client writes
        self._told = slabs.words(self._reply)  # the header that we write
        self._told[slabs.PARKED] = 1  # until the first request
        # The requests that were served, and the client's wishes as they were read last.
        self._served = self._changes = self._cpu = self._spin_ns = 0
        self._step: tuple[int, Any] = 0, None  # ``WRITTEN`` of a step, and its actions in the slab
        self._forms = Forms(self._asked, self._told, self._slot_bytes, space)
        self._scalars = 0  # bytes of the last ones

    def wake(self, *, alone: bool) -> bool:
        """Silence the doorbell and serve; if ``alone``, go on while requests come quickly. Returns
        False if the client has closed its end, so that the doorbell cannot ring again.
        """
        # In this order: a request that comes while we serve rings anew, so its ring must not be
        # read here.
        try:
            rung = bool(os.read(self.bell, 8))
        except BlockingIOError:
            rung = True
        turns = _MOST_AWAKE if alone else 0
        while self.serve() and turns and (self._spin_ns or self.was_awake) and self._wait_awake():
            turns -= 1
        self._told[slabs.PARKED] = 1  # after the last turn, too: the client must ring
        return rung

    def close(self) -> None:
        """Close the doorbells; the slabs go with the last array over them."""
        # A request that was not begun counts as answered: nobody waits for it any more, and the
        # server's idle clock counts answers by this word.
        self._told[slabs.SEQUENCE] = self._asked[slabs.SEQUENCE]
        os.close(self.bell)
        os.close(self._client_bell)

    def _wait_awake(self) -> bool:
        """Poll for the next request without sleeping, for as long as the client says."""
        request, served = self._asked, self._served
        if self._spin_ns:
            self.was_awake = True
            self._told[slabs.PARKED] = 0
            until = perf_counter_ns() + self._spin_ns
            while perf_counter_ns() < until:
                if request[slabs.SEQUENCE] != served:
                    return True
        # In this order: park, then look once more. A client that saw us awake did not ring, so a
        # request that came before the word was written is seen only here.
        self._told[slabs.PARKED] = 1
        return request[slabs.SEQUENCE] != served

    def look_again(self) -> None:
        """Serve a request whose client did not ring, some time after ``wake``."""
        self.was_awake = False
        self.serve()

    def serve(self) -> bool:
        """Serve a request if there is one; returns whether there was."""
        sequence = self._asked[slabs.SEQUENCE]
        if sequence == self._served:
            return False
        words = self._told
        # In this order: results, outcome and length, then the sequence word, which the client
        # polls. Once it has risen everything before it must be readable. The doorbell is last, and
        # only for a client that sleeps.
        words[slabs.OUTCOME], words[slabs.LENGTH] = self._run()
        self._served = sequence
        words[slabs.SEQUENCE] = sequence
        if self._asked[slabs.PARKED]:
            try:  # noqa: SIM105 - as the loop of ``runner.main`` says
                os.write(self._client_bell, _RING)
            except BlockingIOError:
                pass  # it is full: it has been rung already
        return True

    def _run(self) -> tuple[int, int]:
        try:
            changes = self._asked[slabs.CHANGES]
            if changes != self._changes:
                self._changes = changes
                self._change()
            length = self._asked[slabs.MESSAGE]
            return self._run_message(length) if length else self._run_step()
        except BaseException as error:
            message = self._raised(error, "step")
            [frame] = m.pack(message)
            if len(frame) > slabs.INFO_BYTES:  # then it goes without its traceback
                [frame] = m.pack(m.replace(message, traceback=""))
            if (self._watched or self._warned) and self._has_more_to_say():
                self.unsent = [frame]
                return slabs.FETCH, 0
            return slabs.RAISED, self._put(frame)

    def _has_more_to_say(self) -> bool:
        """Whether a step's answer needs a prefix: warnings or changes of watched attributes."""
        if self._watched:
            self._watches.look()
        return bool(self._warned or self._changed)

    def _run_step(self) -> tuple[int, int]:
        raise ValueError("steps of this environment are messages")

    def _put(self, frame: Any) -> int:
        size = memoryview(frame).nbytes
        self._reply[slabs.INFOS : slabs.INFOS + size] = frame
        return size

    def _run_message(self, length: int) -> tuple[int, int]:
        self._told[slabs.OFFERED], self.unsent = 0, []
        count, (known, actions) = self._asked[slabs.WRITTEN], self._step
        if known == count:  # the client has only written new actions into its last message
            return self._step_with(actions.copy())  # an environment may keep its action
        request = self._request_of(length, count)
        if type(request) is m.Step:
            return self._step_with(request.actions)
        return self._send(self._answer(request))

    def _step_with(self, actions: Any) -> tuple[int, int]:
        """Step; the results go into columns if they have their form, else in a message."""
        # First as the environment returned them: what has the form of checked results needs no
        # check of its own.
        result = self._do_step(actions)
        if type(result) is tuple and self._write_columns(result):
            return slabs.COLUMNS, self._scalars
        values = self._complete(result)
        if values is not result and self._write_columns(values):
            return slabs.COLUMNS, self._scalars
        if self._fills_slot():
            self._forms.offer(values)
        frames = self._pack(m.StepDone(*values))
        if self._watched:
            self._watches.look()
        return self._send(frames)

    def _send(self, frames: list[Any]) -> tuple[int, int]:
        self.unsent = frames
        if self._warned or self._changed:
            return slabs.FETCH, 0
        if self._asked[slabs.TO_SLOT]:
            written = write_packet(self._observations, self._slot, self._slot_bytes, frames)
        else:
            written = write_packet(self._reply, slabs.ANSWER, slabs.INFO_BYTES, frames)
        if not written:
            return slabs.FETCH, 0
        self.unsent = []
        return slabs.DONE, written

    @property
    def _slot(self) -> int:
        return (self._asked[slabs.TO_SLOT] - 1) * self._slot_bytes

    def _request_of(self, length: int, count: int) -> m.Message:
        start = self._message
        frames = read_packet(self._requested[start : start + length], DEFAULT_LIMITS)
        request = self._read(frames)
        array = request.actions if type(request) is m.Step else None
        if type(array) is np.ndarray and array.dtype in NUMBERS:  # objects are no bytes in there
            start += array_start(frames, array.nbytes)
            self._step = count, np.ndarray(array.shape, array.dtype, self._request, start)
        return request

    def _fills_slot(self) -> bool:
        """Whether a step's answer goes into a slot, with nothing in front of it."""
        says_more = (self._watched or self._warned) and self._has_more_to_say()
        return bool(self._asked[slabs.TO_SLOT]) and not says_more

    def _write_columns(self, values: Sequence[Any]) -> bool:
        """Write a step's results if they have the form of the columns; returns whether they do."""
        if not self._fills_slot():
            return False
        packed = self._forms.write(values, self._observations, self._slot)
        if packed is None:
            return False
        self._scalars = self._put(packed) if packed else 0
        return True

    def leave_slot(self) -> None:
        """Stop writing into the slot, which the caller may hold: the next batch is a message."""

    def _change(self) -> None:
        self._spin_ns = min(self._asked[slabs.SPIN], slabs.MAX_SPIN_NS)
        if self._asked[slabs.CPU] != self._cpu:
            self._cpu = self._asked[slabs.CPU]
            avoided, core = divmod(self._cpu, slabs.AVOIDED)
            others = own_cores() - {core - 1}
            with contextlib.suppress(OSError):  # it may have gone, or not be ours
                os.sched_setaffinity(0, {core - 1} if core and not avoided else others)

    def infos(self) -> dict[Any, Any]:
        """Returns the last step's infos, which did not fit into the slab."""
        return {}


@lru_cache(maxsize=1)
def own_cores() -> set[int]:
    """The cores before a lane changed them: a user may have restricted them (``taskset``)."""
    return os.sched_getaffinity(0)


class ColumnLane(Lane):
    """A lane of plain sub-environments with spaces of a fixed layout: it reads actions from the
    request slab and writes results into the other slabs.

    Args:
        env: The sub-environments.
        attach: As for ``Lane``; also the shard's rows in the batch.
    """

    def __init__(self, env: SubEnvs, attach: m.Attach, *args: Any) -> None:
        layout = slabs.layout_of(env.single_action_space, env.num_envs)
        observed = slabs.observation_layout(
            env.single_observation_space, attach.count, attach.slots
        )
        if layout is None or observed is None:
            raise ValueError("these spaces have no fixed layout")
        super().__init__(attach, *args)
        self._message = layout.message
        self._layout = layout
        self._env = env
        self._assemble = slabs.assembler(env.single_action_space)
        self._codes: list[int] = []  # dtype codes of the actions, as they were read last
        self._takes: list[Callable[[], Any]] = []  # reads one leaf each, by these codes
        self._pairs: Pairs = []  # the last step's infos, in case the client fetches them
        self._forms = Forms(self._asked, self._told, slabs.INFO_BYTES)
        self._writer = InfoWriter(self._reply, layout.count, self._pack, env.joined, self._forms)
        self._move(attach.start, observed)

    def _move(self, start: int, observed: slabs.ObservationLayout) -> None:
        """Have the environment write into the slabs."""
        batch, count, stop = self._env.batch, observed.count, start + self._layout.count
        rewards, flags = slabs.results(self._observations, observed)
        bools = flags.view(np.bool_)
        batch.rewards = rewards[start:stop]
        batch.terminations = bools[:count][start:stop]
        batch.truncations = bools[count:][start:stop]
        bools[:count][start:stop] = bools[count:][start:stop] = False  # another may have died here
        bases = [slot * observed.slot_bytes for slot in range(observed.slots)]
        rows = [
            [
                slabs.view(self._observations, leaf, base=base)[start:stop]
                for leaf in observed.leaves
            ]
            for base in bases
        ]
        batch.write_to(rows)

    def _run_step(self) -> tuple[int, int]:
        self.unsent = []  # what is fetched after this step are its infos
        # copied, because an environment may keep its action and the client writes the next one
        actions = self._assemble([take() for take in self._takes])
        pairs = self._pairs = self._env.run_step(actions)
        if (self._watched or self._warned) and self._has_more_to_say():
            return slabs.FETCH, 0
        integers, reward = self._env.integers, self._env.reward
        if pairs or True in integers or reward:
            return self._writer.write(pairs, integers, encoded=bool(reward))
        return slabs.DONE, 0

    def _put(self, frame: Any) -> int:
        return self._writer.put(frame)

    def leave_slot(self) -> None:
        """Write the next batch into arrays outside the slot: see ``Lane``."""
        self._env.batch.choose(0, carry=True)
        self._changes = -1

    def _change(self) -> None:
        super()._change()
        request = self._asked
        # A message that moves slots is a reset, which may be of some sub-environments only.
        self._env.batch.choose(request[slabs.SLOT], carry=bool(request[slabs.MESSAGE]))
        codes = request[slabs.DTYPES : slabs.DTYPES + len(self._layout.actions)].tolist()
        if codes != self._codes:
            self._codes, self._takes = codes, []
            for leaf, code in zip(self._layout.actions, codes, strict=True):
                form, code = divmod(code, slabs.LISTED)
                view = slabs.view(self._request, leaf, slabs.ACTION_DTYPES[code])
                self._takes.append((view.copy, view.tolist, partial(_arrays_in, view))[form])

    def infos(self) -> dict[Any, Any]:
        """Returns the last step's infos: see ``Lane``."""
        return self._env.joined(self._pairs)


def _arrays_in(view: Any) -> list[Any]:
    """A list of the numbers, each an array of its own."""
    return [view[index, ...].copy() for index in range(len(view))]


class Forms:
    """Writes results as columns if they have a form that the client has derived, too.

    Args:
        asked, told: The headers of the request and the reply slab.
        room, space: As for ``StepColumns``.
    """

    def __init__(
        self, asked: Any, told: Any, room: int, space: gym.Space[Any] | None = None
    ) -> None:
        self._asked, self._told, self._room, self._space = asked, told, room, space
        self._forms: list[StepColumns | None] = [None] * slabs.FORMS
        self._last = 0  # the number of the form that was used last
        self._fresh, self._offered = -1, 0  # the form not used yet, and of which step it is
        # Results of other forms since the last form was first used, and when to offer the next.
        self._missed, self._offers_at = 0, 1

    def write(self, values: Sequence[Any], memory: Any, start: int) -> bytes | None:
        """Write results as ``StepColumns.write``; None if they have another form."""
        for number in (self._last, 1 - self._last):
            columns = self._forms[number]
            is_new = number == self._fresh
            if columns is None or (is_new and self._asked[slabs.DERIVED] != self._offered):
                continue
            try:
                packed = columns.write(values, memory, start)
            except IrregularError:
                continue
            self._told[slabs.FORM] = self._last = number
            if is_new:
                self._fresh, self._missed, self._offers_at = -1, 0, 1
            return packed
        return None

    def offer(self, values: Sequence[Any]) -> None:
        """Offer columns for such results in place of the form that was not used last, the more
        rarely the more offers were of no use.
        """
        missed = self._missed = self._missed + 1
        if missed >= self._offers_at:
            self._offers_at = missed + 1 + min(missed // 8, _SELDOM)
            with contextlib.suppress(IrregularError):
                columns = StepColumns(values, self._room, self._space)
                self._fresh, self._offered = 1 - self._last, self._asked[slabs.SEQUENCE]
                self._forms[self._fresh] = columns
                self._told[slabs.FORM], self._told[slabs.OFFERED] = self._fresh, columns.digest
                self._offers_at = missed + min(missed + 1, _SELDOM)


class InfoWriter:
    """Writes infos into a slab: as columns while their schema or form stays the same, else encoded.
    ``joined``: joins the pairs of infos; ``forms``: the forms of infos that are not flat.
    """

    def __init__(
        self,
        reply: Any,
        count: int,
        pack: Callable[[m.Message], list[Any]],
        joined: Callable[[Pairs], dict[Any, Any]],
        forms: Forms,
    ) -> None:
        self._reply = reply
        self._count = count
        self._pack = pack
        self._joined = joined
        self._forms = forms
        self._told = slabs.words(reply)
        self._integers: Sequence[bool] = ()
        # The schema that the client knows too: keys and classes of each info, and what writes the
        # values of all, key by key. None: the next infos go encoded.
        self._keys: list[Any] | None = None
        self._types: list[type] = []
        self._write_values: Callable[..., None] = struct.pack_into

    def write(
        self, pairs: Pairs, integers: Sequence[bool] = (), *, encoded: bool = False
    ) -> tuple[int, int]:
        """Writes infos; returns the reply's outcome and length. Raises ``ProtocolError``.
        ``integers``: which parts of the observation are Python ints, which is part of the schema;
        ``encoded``: whether infos hold a value that fits no column, such as a reward that is no
        number.
        """
        unchanged = self._keys is not None and integers == self._integers and not encoded
        if unchanged and self._write_columns(pairs):
            return slabs.COLUMNS, 0
        infos = self._joined(pairs)
        packed = self._forms.write([infos], self._reply, slabs.ANSWER)
        if packed is not None:
            return slabs.FORMED, self.put(packed)
        frames = self._pack(m.Value(infos))
        if len(frames) > 1 or memoryview(frames[0]).nbytes > slabs.INFO_BYTES:
            return slabs.FETCH, 0
        self._told[slabs.OFFERED] = 0
        self._learn(pairs, infos)
        if self._keys is None:
            self._forms.offer([infos])
        self._integers = integers
        return slabs.DONE, self.put(frames[0])

    def put(self, frame: Any) -> int:
        """Write encoded bytes; returns their number."""
        size = memoryview(frame).nbytes
        self._reply[slabs.INFOS : slabs.INFOS + size] = frame
        return size

    def _write_columns(self, pairs: Pairs) -> bool:
        if len(pairs) != self._count:
            return False
        keys, types, rows = self._keys, self._types, []
        for expected, (index, info) in enumerate(pairs):
            values = info.values()
            if index != expected or [*info] != keys or [*map(type, values)] != types:
                return False
            rows.append(values)
        try:
            self._write_values(self._reply, slabs.INFOS, *chain(*zip(*rows, strict=True)))
        except (OverflowError, struct.error):  # an integer beyond 64 bit: joining fails of it, or
            return False  # it goes encoded
        return True

    def _learn(self, pairs: Pairs, infos: dict[Any, Any]) -> None:
        """Learn columns for scalars that every sub-environment has. The client does not read their
        masks, which are all true.
        """
        self._keys = None
        columns = slabs.columns_of(infos)
        first = pairs[0][1] if pairs else {}
        types = list(map(type, first.values()))
        if (
            columns is None
            or len(pairs) != self._count
            or [column.key for column in columns] != [*chain(*((key, f"_{key}") for key in first))]
            or not all(map(batches.is_scalar, types))
        ):
            return
        form, end = "", 0
        for column in columns[::2]:
            form += f"{column.offset - end}x{self._count}{column.dtype.char}"
            end = column.offset + self._count * column.dtype.itemsize
        rows = [column.view(self._reply, slabs.INFOS) for column in columns[::2]]
        # ``struct`` has numpy's codes, but changes the bits of a NaN in fewer than 64
        exact = {"e", "f"}.isdisjoint(form)
        self._write_values = struct.Struct(form).pack_into if exact else partial(_write_rows, rows)
        self._keys, self._types = list(first), types


def _write_rows(rows: Sequence[Any], _: Any, start: int, *values: Any) -> None:
    """Like ``struct.pack_into``, into these rows of equal length."""
    count = len(values) // len(rows)
    for index, row in enumerate(rows):
        row[...] = values[index * count : (index + 1) * count]
