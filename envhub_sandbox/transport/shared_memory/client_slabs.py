"""The client's end of the slabs: writes actions and messages, and reads the runners' answers.

A shard in shared memory has two sealed memfds and a doorbell each way (``LaneShard``), and all
shards write into one slab of observations (``ObservationSlab``). If the server has the slabs, it
sends their contents (``served_lane``). Trust: the jail can write its slabs at any time, so every
word is read once and bounded, and bytes are copied before they are checked. ``F_SEAL_SHRINK`` keeps
the jail from shrinking the memory, which would be a SIGBUS for us.

The caller owns copies of observations, or borrows slots. With one slot every batch is copied out.
With a ring of slots (``copy=False``) the caller gets arrays over the slot itself. The slot is
written again only when no such array is referenced any more: each slot is a map of its own and the
base of every array over it, including views of views, so its reference count shows that. If all
slots are held, the batch goes through the spare slot and is copied. The jail can still write the
memory of a borrowed batch.
"""

from __future__ import annotations

import mmap
import operator
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from envhub_sandbox.errors import RemoteProtocolError, WorkerTimeoutError
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import Frames
from envhub_sandbox.transport.lane import RECHECK_MS
from envhub_sandbox.transport.results import Results
from envhub_sandbox.transport.values import to_tensor, unpacked
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.messages.forms import IrregularError
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.columns import StepColumns
from envhub_worker.protocol.shared_memory.packets import (
    array_start,
    packet_bytes,
    read_packet,
    write_packet,
)
from envhub_worker.protocol.shared_memory.slabs import columns_of

if TYPE_CHECKING:
    from envhub_worker.protocol.shared_memory.descriptors import Watch

Schema = list[tuple[slabs.Column, Any]]
"""The columns of infos, each with its view of the slab."""
Outcome = tuple[int, m.Message | None]
"""``slabs.DONE``, ``RAISED``, ``FETCH`` or ``COLUMNS``, and the message in the slab, if any."""
NO_MORE: Outcome = (slabs.DONE, None)
"""The outcome of a step without infos."""
_OUTCOMES = frozenset({slabs.DONE, slabs.RAISED, slabs.FETCH, slabs.COLUMNS, slabs.FORMED})
_UNKNOWN = -1
RING = 4
"""The number of slots to lend: for the last two batches, and two that a caller keeps."""
_SPARE = 0
_BOOL = np.dtype(np.bool_)
Wishes = tuple[int, int, int]
"""The slot for the observations, the ns to wait awake afterwards, and the core to run on plus one,
or 0 for any core."""


def action_layouts(results: Results) -> list[slabs.Layout] | None:
    """Each shard's layout of actions; None if the spaces have no fixed layout."""
    manifest = results.manifest
    space = manifest.single_action_space
    found = [slabs.layout_of(space, stop - start) for start, stop in results.bounds]
    known = [layout for layout in found if layout is not None]
    return known if manifest.shardable and len(known) == len(found) else None


def message_layouts(results: Results, slots: int) -> list[tuple[slabs.Layout, int]] | None:
    """Each shard's layout for steps as messages, and the size of a slot for an answer; None if
    these are too large.
    """
    manifest, layouts = results.manifest, []
    observed, acted = manifest.single_observation_space, manifest.single_action_space
    for start, stop in results.bounds:
        count = stop - start
        if not manifest.shardable:  # its batch may be another than that of the single space
            observed, acted, count = manifest.observation_space, manifest.action_space, 1
        layout, slot_bytes = slabs.message_layout(acted, count), slabs.answer_bytes(observed, count)
        if layout is None or slot_bytes * slots > slabs.MAX_SLAB_BYTES:
            return None
        layouts.append((layout, slot_bytes))
    return layouts


class ShardSlabs:
    """The request slab and the reply slab of one shard.

    A field that remembers a slab's content is cleared before the slab is written, and set again
    afterwards: docs/internals/interruption.md, rule 3.

    Args:
        layout: The layout of the request slab.
        request: The memory of the request slab.
        reply: The memory of the reply slab.

    Attributes:
        schema: The columns of the infos; a new schema makes a new list.
        told_bytes, answer_bytes: The total bytes of messages and of their answers so far.
    """

    def __init__(self, layout: slabs.Layout, request: Any, reply: Any) -> None:
        self.layout = layout
        self._request, self._reply = request, reply
        self._asks = slabs.words(request)  # the header that we write
        self._tells = slabs.words(reply)  # the header that the runner writes: read each word once
        self.schema: Schema = []  # of the infos that came encoded last
        self._columns = Copies((), (), dict)  # makes infos of these
        # By leaf and dtype: the dtype's code, and the leaf's area in the slab as an array of it.
        self._views: dict[tuple[int, Any], Any] = {}
        self._codes = [_UNKNOWN] * len(layout.actions)  # as they stand in the slab
        self._wishes: Wishes | None = (0, 0, 0)  # as they stand in the slab
        self._told = False  # whether the last request was a message
        self._dtype: Any = None  # of the last actions, where these are one array
        self._only: Any = None  # the slab as such an array
        self._answers = memoryview(reply)[slabs.ANSWER : slabs.ANSWER + slabs.INFO_BYTES]
        # Where the answer to it comes; None: the reply slab.
        self._answer_slots: SlotRing | None = None
        self.told_bytes = self.answer_bytes = 0
        # Derived from the answers that were offered, by the number of the form.
        self._forms: dict[int, StepColumns] = {}
        self._form: StepColumns | None = None  # of the last answer
        self._actions: Any = None  # the slab as the actions of a step that is a message
        self._told_frames: Frames = []  # of the last message, until its actions are noted

    def write(self, leaves: Sequence[Any], wishes: Wishes) -> None:
        """Write a shard's actions."""
        only = leaves[0] if leaves else None  # a space without members has none
        if type(only) is np.ndarray and only.dtype is self._dtype and not self._told:
            self._only[...] = only  # the usual case: the same dtype as in the last step
        else:
            self._write(leaves)
        if wishes != self._wishes:
            self._wish(*wishes)

    def _write(self, leaves: Sequence[Any]) -> None:
        asks = self._asks
        if self._told:
            asks[slabs.MESSAGE] = 0
            self._told = False
        for index, leaf in enumerate(leaves):
            listed = 0 if type(leaf) is not list else 1 + (type(leaf[0]) is np.ndarray)
            array = np.asarray(leaf) if listed else leaf
            found = self._views.get((index, array.dtype))
            if found is None:
                found = self._view(index, array.dtype)
            code = found[0] + slabs.LISTED * listed
            if self._codes[index] != code:
                self._codes[index] = _UNKNOWN
                self._dtype = None
                asks[slabs.DTYPES + index] = code
                asks[slabs.CHANGES] += 1
                self._codes[index] = code
            found[1][...] = array
            if len(leaves) == 1 and not listed:
                self._only = found[1]
                self._dtype = array.dtype

    def has_room(self, frames: Frames) -> bool:
        """Whether a message fits into the request slab."""
        return packet_bytes(frames) <= self.layout.request_bytes - self.layout.message

    def write_message(self, frames: Frames, wishes: Wishes, slots: SlotRing | None = None) -> None:
        """Write a message, for which it ``has_room``, in the place of actions.
        ``slots``: the ring whose chosen slot gets the answer; None for the reply slab.
        """
        asks, start = self._asks, self.layout.message
        self._told, self._actions = True, None
        self._told_frames = frames
        length = write_packet(self._request, start, self.layout.request_bytes - start, frames)
        asks[slabs.MESSAGE] = length
        asks[slabs.WRITTEN] += 1
        self.told_bytes += length
        asks[slabs.TO_SLOT] = 0 if slots is None else 1 + slots.chosen
        self._answer_slots = slots
        if wishes != self._wishes:
            self._wish(*wishes)

    def note_actions(self, actions: Any) -> None:
        """Note the actions of the step that was written as a message: if they are one array,
        ``write_actions`` can write later actions of the same form in their place.
        """
        frames, self._told_frames = self._told_frames, []
        if type(actions) is not np.ndarray or actions.dtype.kind not in "biufc":
            return
        if actions.dtype.isnative:  # the message has them in native byte order
            start = self.layout.message + array_start(frames, actions.nbytes)
            self._actions = np.ndarray(actions.shape, actions.dtype, self._request, start)

    def write_actions(self, actions: Any, wishes: Wishes, slots: SlotRing) -> bool:
        """Write actions into the last message, if it is a step with such actions; whether it is."""
        array = self._actions
        if array is None or type(actions) is not np.ndarray or actions.dtype is not array.dtype:
            return False
        if actions.shape != array.shape:
            return False
        self._actions = None
        array[...] = actions
        self._asks[slabs.TO_SLOT] = 1 + slots.chosen
        self.told_bytes += self._asks[slabs.MESSAGE]
        if wishes != self._wishes:
            self._wish(*wishes)
        self._actions = array
        return True

    def _wish(self, slot: int, spin_ns: int, cpu: int) -> None:
        asks = self._asks
        self._wishes = None
        asks[slabs.SPIN] = spin_ns
        asks[slabs.SLOT] = slot
        asks[slabs.CPU] = cpu
        asks[slabs.CHANGES] += 1
        self._wishes = (slot, spin_ns, cpu)

    def _view(self, index: int, dtype: Any) -> tuple[int, Any]:
        code = slabs.DTYPE_CODES[dtype]
        leaf = self.layout.actions[index]
        made = self._views[index, dtype] = (code, slabs.view(self._request, leaf, dtype))
        return made

    @property
    def known(self) -> int:
        """The bytes that the columns of infos take."""
        return self._asks[slabs.KNOWN]

    def has_nothing_to_say(self) -> bool:
        """Whether the reply has results only, without infos."""
        tells = self._tells
        return tells[slabs.OUTCOME] == slabs.DONE and not tells[slabs.LENGTH]

    def outcome(self) -> Outcome:
        """The outcome of the request. Trust: input from the worker; the length is bounded here.

        An encoded message is always decoded, since it may have the schema of later columns.
        """
        kind, length = self._tells[slabs.OUTCOME], self._tells[slabs.LENGTH]
        is_known = kind in _OUTCOMES and not (kind == slabs.FORMED and self._told)
        if not is_known or length > slabs.INFO_BYTES:
            raise RemoteProtocolError("the worker wrote an impossible reply into its slab")
        start = slabs.INFOS
        if kind == slabs.FORMED:
            form, packed = self._form_of(length), bytes(self._reply[start : start + length])
            return slabs.DONE, m.Value(*form.read(self._reply, slabs.ANSWER, packed, to_tensor))
        if not length:
            return kind, None
        message = unpacked([self._reply[start : start + length]])
        if isinstance(message, m.RaisedException):  # whatever kind the worker wrote
            return slabs.RAISED, message
        if isinstance(message, m.Value) and type(message.value) is dict:
            if not self._told:
                self._derive([message.value], slabs.INFO_BYTES)
            with UNTRUSTED:
                infos, columns = message.value, columns_of(message.value) or ()
                beside = {key: value for key, value in infos.items() if type(key) is int}
                self.schema = [(column, column.view(self._reply, start)) for column in columns]
                masks = masks_of(columns)
                forms = {column.key: masks.get(column.key) for column in columns}
                self._columns = Copies(
                    [view for column, view in self.schema if column.key not in masks],
                    [column.dtype for column in columns if column.key not in masks],
                    partial(_infos_of_copies, forms, beside),
                )
                known = (column.offset + view.nbytes for column, view in self.schema)
                self._asks[slabs.KNOWN] = max(known, default=0)
        return kind, message

    def answer(
        self, limits: WireLimits = DEFAULT_LIMITS, space: gym.Space[Any] | None = None
    ) -> m.Message | None:
        """The answer to a message; None if it did not fit. Trust: as ``outcome``.
        ``space``: as for ``StepColumns``.
        """
        kind, length = self._tells[slabs.OUTCOME], self._tells[slabs.LENGTH]
        slots, self._form = self._answer_slots, None
        if kind == slabs.FETCH:
            return None
        area = self._answers if slots is None else slots.bytes_of_chosen()
        if kind == slabs.COLUMNS and slots is not None:
            return m.StepDone(*self._step_of_columns(self._form_of(length), length, slots))
        if kind not in (slabs.DONE, slabs.RAISED) or length > len(area):
            raise RemoteProtocolError("the worker wrote an impossible answer into its slab")
        if kind == slabs.RAISED:
            return self.outcome()[1]
        self.answer_bytes += length
        with UNTRUSTED:
            frames = read_packet(area[:length], limits)
        borrows = slots is not None and slots.chosen != _SPARE
        message = unpacked(frames, limits=limits, borrows=borrows)
        if slots is not None and type(message) is m.StepDone:
            self._form = self._derive(m.values_of(message), slots.slot_bytes, space)
        return message

    def _derive(
        self, values: Sequence[Any], room: int, space: gym.Space[Any] | None = None
    ) -> StepColumns | None:
        """Derive the columns that the runner offers with these values; None if there are none.
        Trust: the number of the form is input from the worker.
        """
        offered, number = self._tells[slabs.OFFERED], self._tells[slabs.FORM]
        if not offered or number >= slabs.FORMS:
            return None
        # 0 until the columns exist: after an interrupt the runner sends none that we lack
        self._asks[slabs.DERIVED] = 0
        with suppress(IrregularError):
            columns = StepColumns(values, room, space)
            if columns.digest == offered:  # the runner's Gymnasium may know other spaces
                self._forms[number] = columns
                self._asks[slabs.DERIVED] = self._asks[slabs.SEQUENCE]
                return columns
        return None

    def _form_of(self, length: int) -> StepColumns:
        """The form of an answer with so many bytes of scalars. Trust: input from the worker."""
        columns = self._forms.get(self._tells[slabs.FORM])
        if columns is None or length > slabs.INFO_BYTES:
            raise RemoteProtocolError("the worker wrote an impossible answer into its slab")
        return columns

    def _step_of_columns(self, columns: StepColumns, length: int, slots: SlotRing) -> list[Any]:
        self._form = columns
        packed = bytes(self._reply[slabs.INFOS : slabs.INFOS + length]) if length else b""
        values = columns.read(*slots.whole, packed, to_tensor, slots.borrowed)
        self.answer_bytes += columns.read_bytes + length
        return values

    def checked_step(self) -> list[Any] | None:
        """The fields of a step's answer, if it has columns of a form that ``note_checked`` noted;
        else None. Raises as ``answer``.
        """
        tells, slots = self._tells, self._answer_slots
        if tells[slabs.OUTCOME] != slabs.COLUMNS or slots is None:
            return None
        length = tells[slabs.LENGTH]
        columns = self._form_of(length)
        return self._step_of_columns(columns, length, slots) if columns.checked else None

    def note_checked(self, restores: bool) -> None:
        """Note that the classes, dtypes and shapes of the last step's answer are as declared.
        ``restores``: as for ``Results``.
        """
        if self._form is not None and (self._form.has_classes or not restores):
            self._form.checked = True

    def prepare(self) -> None:
        """Make the arrays of infos that come as columns: see ``Copies``."""
        self._columns.prepare()

    def columns(self) -> dict[Any, Any]:
        """The infos that came as columns, copied into new arrays."""
        if not self.schema:
            raise RemoteProtocolError("the worker sent columns before their schema")
        columns: dict[Any, Any] = self._columns.take()
        return columns

    def close(self) -> None:
        """Release the views; the maps go with the last array over them."""
        self._asks.release()
        self._tells.release()
        self._answers.release()


class LaneShard(ShardSlabs):
    """The slabs and doorbells of one shard, in memory shared with its runner.

    Args:
        layout: The layout of the request slab.
        observations: The descriptor of the slab that all shards share.

    Attributes:
        fds: The descriptors for the runner: three slabs, its doorbell and ours.
        bell: Our doorbell, which the runner rings.
    """

    def __init__(self, layout: slabs.Layout, observations: int) -> None:
        # imported late: only Linux has these modules' dependencies
        from envhub_worker.protocol.shared_memory.descriptors import (
            SEAL_FUTURE_WRITE,
            OwnBell,
            RunnerBell,
            sealed_memfd,
        )

        asks, request = sealed_memfd("request", layout.request_bytes, SEAL_FUTURE_WRITE)
        tells, reply = sealed_memfd("reply", slabs.REPLY_BYTES)
        super().__init__(layout, asks, tells)
        self._runner_bell, self.bell = RunnerBell(), OwnBell()
        self._ring = self._runner_bell.ring
        self._slab_files = [request, reply]  # ours until the runner has its own
        bells = [self._runner_bell.theirs, self.bell.fileno()]
        self.fds = [request.fileno(), reply.fileno(), observations, *bells]
        self.sequence = 0  # requests so far

    def handed_over(self) -> None:
        """Close our copies of the runner's descriptors; the maps keep the memory alive."""
        while self._slab_files:
            self._slab_files.pop().close()
        self._runner_bell.handed_over()

    def announce(self) -> None:
        """Tell the runner that a request is written; ring its doorbell if it sleeps."""
        self.sequence += 1
        # In this order. The word comes after what it announces, which the runner reads as soon as
        # it sees it. The runner sets its parked word and then looks for a request once more
        # (``runner.lane``), so it sees this request or we see that it sleeps.
        self._asks[slabs.SEQUENCE] = self.sequence
        if self._tells[slabs.PARKED]:
            self._ring()

    def answered(self) -> bool:
        """Whether the reply to the last request is there."""
        return self._tells[slabs.SEQUENCE] == self.sequence

    def listen(self, wanted: bool) -> None:
        """Say whether to ring our doorbell. An answer may come just before: look again soon."""
        self._asks[slabs.PARKED] = wanted

    def answered_until(self, until_ns: int) -> bool:
        """Wait awake for the reply; returns whether it came before ``until_ns``."""
        tells, sequence = self._tells, self.sequence
        while tells[slabs.SEQUENCE] != sequence:
            if perf_counter_ns() > until_ns:
                return False
        return True

    def has_more_elsewhere(self) -> bool:
        """Whether a part of the reply did not fit the slab and has to be fetched."""
        return self._tells[slabs.OUTCOME] == slabs.FETCH

    def answered_before_death(self, watch: Watch, deadline: Deadline) -> bool:
        """Sleep until the reply is there or a process dies; returns whether the reply is there.
        Raises ``WorkerTimeoutError``: the deadline came first.
        """
        self._asks[slabs.PARKED] = 1  # ask the runner to ring our doorbell
        try:
            # the runner may have answered just before PARKED was set: look again soon, once
            timeout: int | None = RECHECK_MS
            while not self.answered():
                died = watch.wait(timeout)
                if self.answered():
                    return True
                if died:
                    return False
                if deadline.passed:
                    raise WorkerTimeoutError("the worker did not answer in time")
                timeout = deadline.left_ms()
            return True
        finally:
            self._asks[slabs.PARKED] = 0

    def close(self) -> None:
        """Close the doorbells and descriptors, and release the slabs."""
        self.handed_over()
        self._runner_bell.close()
        self.bell.close()
        super().close()


def masks_of(columns: Sequence[slabs.Column]) -> dict[str, Any]:
    """The masks among columns. Infos come as columns only if every sub-environment has each value,
    so the masks are all true, and nobody reads what the worker writes there.
    """
    keys = {f"_{column.key}" for column in columns}
    return {
        column.key: np.ones(column.shape, np.bool_)
        for column in columns
        if column.key in keys and column.dtype == _BOOL
    }


def _infos_of_copies(
    forms: dict[str, Any], beside: dict[Any, Any], copies: Sequence[Any]
) -> dict[Any, Any]:
    values = iter(copies)
    infos = {key: next(values) if mask is None else mask.copy() for key, mask in forms.items()}
    return {**infos, **beside}


class Copies:
    """Copies arrays of a slab into new ones, which the caller owns.

    Args:
        views: The arrays of the slab, booleans as bytes. The copy casts them: viewed as bool, a
            hostile byte of 2 would be neither True nor False.
        dtypes: The dtype of each copy.
        assemble: Makes what the caller gets from the list of copies.
    """

    def __init__(
        self, views: Sequence[Any], dtypes: Sequence[Any], assemble: Callable[[list[Any]], Any]
    ) -> None:
        self._views, self._assemble = views, assemble
        self._forms = [(view.shape, dtype) for view, dtype in zip(views, dtypes, strict=True)]
        self._next: tuple[list[Any], Any] | None = None

    def prepare(self) -> tuple[list[Any], Any]:
        """Make the next copies, still without content, before somebody waits for them."""
        if self._next is None:
            arrays = [np.empty(shape, dtype) for shape, dtype in self._forms]
            self._next = arrays, self._assemble(arrays)
        return self._next

    def take(self) -> Any:
        """The copies, in the caller's form."""
        (arrays, whole), self._next = self.prepare(), None
        for index, array in enumerate(arrays):
            array[...] = self._views[index]
        return whole


class JoinedColumns:
    """Joins the infos of all shards, if all came as the same columns, with one copy of each column.

    With many shards, joining takes most of the time of a step with infos.

    Args:
        schemas: The schema of each shard.
        bounds: The slice of sub-environments of each shard.

    Attributes:
        columns: Name, shape, dtype and the shards' parts of each column, no parts of a mask; empty
            if the schemas differ, or if a column lacks a value for some sub-environment.
    """

    def __init__(self, schemas: Sequence[Schema], bounds: Sequence[tuple[int, int]]) -> None:
        self._schemas = schemas
        self.columns: list[tuple[str, tuple[int, ...], Any, list[Any]]] = []
        forms = [[(one.key, one.dtype, one.shape[1:]) for one, _ in schema] for schema in schemas]
        rows = [{one.shape[0] if one.shape else 0 for one, _ in schema} for schema in schemas]
        if forms and forms == [forms[0]] * len(forms) and rows == [{b - a} for a, b in bounds]:
            masks = masks_of([column for column, _ in schemas[0]])
            for index, (key, dtype, tail) in enumerate(forms[0]):
                parts = [] if key in masks else [schema[index][1] for schema in schemas]
                self.columns.append((key, (bounds[-1][1], *tail), dtype, parts))

    def is_of(self, schemas: Sequence[Schema]) -> bool:
        """Whether it was made of these schemas."""
        known = self._schemas
        return len(known) == len(schemas) and all(map(operator.is_, known, schemas))

    def infos(self) -> dict[Any, Any]:
        """The joined infos, in new arrays. Trust: reads each byte once; a nonzero byte is true."""
        return {
            key: np.concatenate(parts, out=np.empty(shape, dtype), casting="unsafe")
            if parts
            else np.ones(shape, dtype)
            for key, shape, dtype, parts in self.columns
        }


def infos_of(shard: ShardSlabs, outcome: Outcome, results: Results) -> dict[Any, Any]:
    """A shard's infos of a step, all of which have arrived. Trust: input from the worker.
    Raises ``RemoteEnvError``: the environment raised.
    """
    kind, message = outcome
    return shard.columns() if kind == slabs.COLUMNS else results.info(message)


class SlotRing:
    """A slab of slots; each batch goes into a slot that no caller holds.

    Args:
        count, slot_bytes, total_bytes: The number of slots, the size of each, and of the slab.

    Attributes:
        fd: The slab's descriptor, for the runners.
        chosen: The slot of the last batch.
    """

    def __init__(self, count: int, slot_bytes: int, total_bytes: int) -> None:
        # imported late: only Linux has this module's dependencies
        from envhub_worker.protocol.shared_memory.descriptors import sealed_memfd

        self.count, self.slot_bytes = count, slot_bytes
        self._memory, self._file = sealed_memfd("observations", total_bytes)
        self.fd = self._file.fileno()
        if count == 1:
            self._slots = [self._memory]
        else:
            offsets = range(0, count * slot_bytes, slot_bytes)
            self._slots = [mmap.mmap(self.fd, slot_bytes, offset=offset) for offset in offsets]
        # counted exactly as in choose(): a loop variable would add a reference
        self._unheld = [sys.getrefcount(self._slots[index]) for index in range(len(self._slots))]
        self.chosen = _SPARE

    def choose(self) -> int:
        """Choose the slot for the next batch: the lowest free one, so that few slots stay hot."""
        self.chosen = _SPARE
        for index in range(1, len(self._slots)):
            if sys.getrefcount(self._slots[index]) == self._unheld[index]:
                self.chosen = index
                break
        return self.chosen

    def leave(self) -> None:
        """Choose the spare slot, so that no held slot is written: the next batch is a message."""
        self.chosen = _SPARE

    @property
    def whole(self) -> tuple[Any, int]:
        """The memory of all slots, whose views hold no slot, and the offset of the chosen slot."""
        return self._memory, self.chosen * self.slot_bytes

    @property
    def borrowed(self) -> Any:
        """The chosen slot, if the caller borrows the batch in it; None if the batch is copied."""
        return None if self.chosen == _SPARE else self._slots[self.chosen]

    def bytes_of_chosen(self) -> memoryview:
        """A view of the chosen slot, which counts as held while the view exists."""
        return memoryview(self._slots[self.chosen])[: self.slot_bytes]

    def close(self) -> None:
        """Close the descriptor; the memory goes with the last array over it."""
        self._file.close()


class ObservationSlab(SlotRing):
    """The slab that all shards write their rows into: observations, rewards and flags.
    ``space``: the single observation space.
    ``layout``: the layout of the slab.
    """

    def __init__(self, space: gym.Space[Any], layout: slabs.ObservationLayout) -> None:
        super().__init__(layout.slots, layout.slot_bytes, layout.total_bytes)
        self.layout = layout
        self._assemble = slabs.assembler(space)
        self._leaves = Copies(*_readable(self._slots[_SPARE], layout), self._assemble)
        rewards, flags = slabs.results(self._memory, layout)
        views = rewards, flags[: layout.count], flags[layout.count :]
        self._columns = Copies(views, [rewards.dtype, _BOOL, _BOOL], tuple)
        self._unheld = [sys.getrefcount(self._slots[index]) for index in range(len(self._slots))]

    def prepare(self) -> None:
        """Make the arrays of the next batch: see ``Copies``."""
        if self.chosen == _SPARE:
            self._leaves.prepare()
        self._columns.prepare()

    def take(self) -> Any:
        """The batch in the chosen slot, in the structure of the space."""
        if self.chosen == _SPARE:
            return self._leaves.take()
        views, dtypes = _readable(self._slots[self.chosen], self.layout)
        pairs = zip(views, dtypes, strict=True)
        return self._assemble([view.astype(dtype, copy=False) for view, dtype in pairs])

    def results(self) -> tuple[Any, Any, Any]:
        """Copies of rewards (float64), terminations and truncations (bool), ``(num_envs,)``."""
        results: tuple[Any, Any, Any] = self._columns.take()
        return results


def _readable(slot: Any, layout: slabs.ObservationLayout) -> tuple[list[Any], list[Any]]:
    """Views of the leaves in a slot, of booleans as bytes, and the dtypes that the caller gets."""
    dtypes = [leaf.dtype for leaf in layout.leaves]
    readable = [np.dtype(np.uint8) if dtype == _BOOL else dtype for dtype in dtypes]
    pairs = zip(layout.leaves, readable, strict=True)
    return [slabs.view(slot, leaf, dtype) for leaf, dtype in pairs], dtypes
