"""The runner: holds live vector environments of a jail and answers requests about them.

A table maps each message to a small function. The runner exchanges length-prefixed packets over one
inherited stream, on the main thread (a repository may set signal handlers), and ends with the
stream.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import traceback
import warnings
from array import array
from collections.abc import Callable, Collection, Iterator
from functools import partial
from time import monotonic
from typing import Any, NamedTuple

import cloudpickle  # type: ignore[import-untyped]
import gymnasium as gym
import numpy as np

from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec import unsendable as unsendable  # a reply may need it later
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits, limits_for
from envhub_worker.protocol.manifest.manifest import encode_env, encode_manifest
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.spaces.spaces import seeded_nodes, seeded_states
from envhub_worker.protocol.stream import Packet, StreamReader, pack_packet
from envhub_worker.runner import gymnasium_compat as compat
from envhub_worker.runner import loader, manifest
from envhub_worker.runner.described import described, numbered, raised
from envhub_worker.runner.independence import Budget, are_independent
from envhub_worker.runner.lane import ColumnLane, Lane
from envhub_worker.runner.prefixes import WarningLog, Watches
from envhub_worker.runner.recording import standing_in
from envhub_worker.runner.returned import misfit_in_vector
from envhub_worker.runner.state import generators
from envhub_worker.runner.state.shared_state import SharedState
from envhub_worker.runner.state.space_numbers import SpaceNumbers
from envhub_worker.runner.sync_envs import Pairs, SubEnvs
from envhub_worker.runner.tasks import ResultError, Task, tasks_of

_ANCILLARY_BYTES = socket.CMSG_SPACE(8 * array("i").itemsize)
_RECHECK_MS = 2
_DRAWS = (
    "it draws from its own action_space, which seeds and draws of the caller's copy do not change: "
    "set a seeded space in it, envs[0].unwrapped.action_space = space"
)
_MOST_WRAPPERS = 100
_PLAY_S, _PLAY_MEMORY = 20.0, 0.5
"""Seconds and share of the jail's memory that playing the sub-environments of all tasks may take,
to see whether they are independent."""


def main(stream: socket.socket, spec: JailSpec, fds: list[int]) -> int:
    """Serve until the other side closes the stream. Runs confined, as the jail's main program."""
    limits = limits_for(spec.confinement.limits.message_bytes)
    play_bytes = int(spec.confinement.limits.memory_bytes * _PLAY_MEMORY)
    runner = Runner(spec.snapshot, spec.entry, limits, play_bytes)
    runner.warned.listen()
    reader = StreamReader()
    poller = select.poll()
    poller.register(stream, select.POLLIN)
    timeout: int | None = None
    bells: dict[int, Lane] = {}
    # Many runners take turns on a core and find its caches cold: what each wake-up runs is short.
    while True:
        ready = dict(poller.poll(timeout))
        if stream.fileno() in ready:
            if not _serve(stream, reader, runner):
                return 0
        else:
            for bell in ready:
                # Only a single lane may poll for its next request: it would block other lanes.
                if not bells[bell].wake(alone=len(bells) == 1):
                    runner.forget_lane(bells[bell])
            if not ready:
                for lane in bells.values():
                    lane.look_again()
        if [*bells.values()] != [*runner.lanes.values()]:
            bells = _hear(poller, bells, runner.lanes.values())
        # A request may come while a lane stops to wait awake: its client may still read that it
        # does, and not ring. So the first sleep is short, and its end looks at every lane.
        timeout = None
        for lane in bells.values():
            if lane.was_awake:
                timeout = _RECHECK_MS


def _hear(poller: select.poll, bells: Collection[int], lanes: Collection[Lane]) -> dict[int, Lane]:
    """Watch the doorbells of these lanes only; returns lanes by doorbell."""
    for bell in bells:
        poller.unregister(bell)
    for lane in lanes:
        poller.register(lane.bell, select.POLLIN)
    return {lane.bell: lane for lane in lanes}


def _serve(stream: socket.socket, reader: StreamReader, runner: Runner) -> bool:
    """Answer the requests that have arrived; returns False at the end of the stream."""
    data, ancillary, _, _ = stream.recvmsg(reader.chunk, _ANCILLARY_BYTES)
    runner.descriptors = [fd for part in ancillary for fd in array("i", part[2])]
    for packet in reader.feed(data):
        _send(stream, packet.request_id, runner.answer(packet))
    return bool(data)


def _send(stream: socket.socket, request_id: int, frames: list[Any]) -> None:
    buffers = [memoryview(buffer).cast("B") for buffer in pack_packet(request_id, frames)]
    while buffers:
        sent = stream.sendmsg(buffers[:512])
        while buffers and sent >= buffers[0].nbytes:
            sent -= buffers.pop(0).nbytes
        if sent:
            buffers[0] = buffers[0][sent:]


class Runner:
    """The state of one runner: the repository's tasks and the environments built of them."""

    def __init__(
        self,
        snapshot: str,
        entry: str,
        limits: WireLimits = DEFAULT_LIMITS,
        play_bytes: int = 1 << 30,
    ) -> None:
        self._numbers = SpaceNumbers()
        self._first_spaces: dict[int, _FirstSpaces] = {}
        self._pack = partial(m.pack, describer=partial(numbered, self._numbers), limits=limits)
        self._pack_infos = partial(m.pack, describer=described, limits=limits, reduces=True)
        self._snapshot = snapshot
        self._entry = entry
        self._tasks: dict[tuple[str, Any], Task] = {}
        self._envs: dict[int, Any] = {}  # by the client's number
        # By the same number, once asked for.
        self._generators: dict[int, generators.Generators] = {}
        self._play_bytes = play_bytes
        self._stage = ""  # where an exception is said to have been raised
        self.warned = WarningLog()
        self.watches = Watches()
        self.lanes: dict[int, Lane] = {}  # by the environment's number
        self.descriptors: list[int] = []  # that came with the last packet, for an ``Attach``

    def answer(self, packet: Packet) -> list[Any]:
        """Returns the reply's frames, with warnings and changes in front of them."""
        return self.watches.in_front(self.warned.in_front(self.reply(packet)))

    def reply(self, packet: Packet) -> list[Any]:
        """Returns the reply's frames; an error of the repository becomes ``RaisedException``."""
        request = self.read(packet.frames)
        lane = self.lanes.get(getattr(request, "env", -1))
        if lane is not None:
            if isinstance(request, m.FetchInfos) and lane.unsent:
                return lane.unsent
            if isinstance(request, (m.Reset, m.Step)):
                lane.leave_slot()
        return self._reply_to(request)

    def read(self, frames: list[Any]) -> m.Message:
        """Decodes a request; returns ``RaisedException``, its answer, if that fails."""
        try:
            # The caller's own arguments may be pickled. Only this line unpickles.
            return m.unpack(frames, unpickler=cloudpickle.loads)
        except Exception as error:  # of a class that is not to be had here, for instance
            return raised(error, "arguments", self._snapshot)

    def _reply_to(self, request: m.Message, *, in_columns: bool = False) -> list[Any]:
        """Like ``reply``, for a decoded request.
        ``in_columns``: whether observations lie in a slab already.
        """
        self._stage = type(request).__name__.lower()
        try:
            reply = _HANDLERS[type(request)](self, request)
            if in_columns and isinstance(reply, m.ResetDone):
                reply = m.Value(reply.info)
            return (self._pack_infos if type(request) in _WITH_INFOS else self._pack)(reply)
        except ResultError as error:
            return m.pack(raised(error, "return", self._snapshot))
        except BaseException as error:
            return m.pack(raised(error, self._stage, self._snapshot))
        finally:
            if self.watches.readings:
                self.watches.look()

    def load(self, request: m.Load) -> m.Message:
        """Import the repository, call ``make_env`` and describe the result."""
        latest = monotonic() + request.play_ms / 1000
        tasks = self._load(request)
        budget = Budget(min(latest, monotonic() + _PLAY_S), self._play_bytes)
        for task in tasks:
            if task.may_share and request.play_ms > 0:
                task.independent = are_independent(task, self._snapshot, budget)
        made = manifest.describe(tasks)
        return m.LoadDone(encode_manifest(made))

    def load_task(self, request: m.LoadTask) -> m.Message:
        """Import the repository and call ``make_env``; the client has the description already."""
        self._load(request)
        task = self._tasks.get((request.suite, request.task))
        return m.Value(None if task is None else (task.num_envs, task.recording is not None))

    def _load(self, request: m.Load | m.LoadTask) -> list[Task]:
        self._stage = "import"
        # A folder of the jail's own: its home, unless the caller's HOME names another.
        home = os.environ.get("HOME", "")
        scratch = home if os.access(home, os.W_OK | os.X_OK) else os.getcwd()
        make_env = loader.import_entry(self._snapshot, self._entry, scratch)
        self._stage = "make_env"
        # Gymnasium's vector classes are stood in for: nothing is built before it is used.
        with standing_in():
            result = loader.call_make_env(make_env, request)

        def again() -> Any:
            one = m.Load(1, request.use_async_envs, request.cfg, request.env_kwargs)
            return loader.call_make_env(make_env, one)

        tasks = tasks_of(result, request.n_envs, request.use_async_envs, again)
        self._tasks = {(task.suite, task.task): task for task in tasks}
        return tasks

    def build(self, request: m.Build) -> m.Message:
        """Build a slice of a task."""
        task = self._tasks[request.suite, request.task]
        watched = task.is_unlike_gymnasium(request.stop - request.start)
        shared = SharedState(self._snapshot, self.warned.note_shared) if watched else None
        env = self._envs[request.env] = task.build(request.start, request.stop)
        if shared is not None:
            env.shared = shared
            shared.built(env.envs)
        self._numbers.built(_declared_spaces(env), request.start)
        if not request.start:
            self._first_spaces[request.env] = _first_spaces(env)
        return m.BuildDone(encode_env(manifest.describe_vector(task, env)))

    def reset(self, request: m.Reset) -> m.Message:
        """``VectorEnv.reset``."""
        env = self._envs[request.env]
        reply = self._reset(env, request)
        self._note_seeded(request.env, env)
        return reply

    def _reset(self, env: Any, request: m.Reset) -> m.Message:
        if isinstance(env, SubEnvs):
            infos = env.joined(env.run_reset(request.seeds, request.options, request.mask))
            return m.ResetDone(env.batch.observation(), infos)
        options: Any = request.options
        if request.mask is not None:
            options = {} if options is None else options  # our own copy
            options["reset_mask"] = request.mask
        result = _call_own(env, "reset", seed=request.seeds, options=options)
        return m.ResetDone(*compat.reset_result(env, result))

    def _note_seeded(self, number: int, env: Any) -> None:
        """Tell the client if a reset has seeded or replaced the first sub-environment's spaces."""
        before = self._first_spaces.get(number)
        if before is None:
            return
        # kept, so that no other object gets an id of theirs
        now = self._first_spaces[number] = _first_spaces(env)
        seeded = list(map(id, now.generators)) != list(map(id, before.generators))
        if getattr(env, "apart", False) and any(bits.state != old for bits, old in before.acting):
            warnings.warn(_DRAWS, stacklevel=2)
        replaced = True
        with contextlib.suppress(Exception):  # a custom space may compare itself in any way
            replaced = now.spaces != before.spaces
        if replaced or (seeded and any(map(seeded_states, now.spaces))):
            self.watches.changed[number, m.SPACES] = None

    def step(self, request: m.Step) -> m.Message:
        """``VectorEnv.step``."""
        step, complete = _stepping(self._envs[request.env])
        return m.StepDone(*complete(step(request.actions)))

    def revive(self, request: m.Revive) -> m.Message:
        """Reset sub-environments that replace dead ones: see ``m.Revive``."""
        env = self._envs[request.env]
        if isinstance(env, SubEnvs):
            return m.StepDone(*_results(env, env.run_revive(request.seeds, request.rollout)))
        observation, info = compat.reset_result(env, env.reset(seed=request.seeds))
        no, yes = np.zeros(env.num_envs, np.bool_), np.ones(env.num_envs, np.bool_)
        return m.StepDone(observation, np.zeros(env.num_envs), no, yes, info)

    def attach(self, request: m.Attach) -> m.Message:
        """Serve an environment's steps over slabs from now on."""
        env = self._envs[request.env]
        in_columns = request.count > 0
        options: tuple[Any, ...] = (
            None if in_columns else getattr(env, "single_observation_space", None),
            *_stepping(env),
            self._pack_infos,
            self.descriptors,
            self.read,
            partial(self._reply_to, in_columns=in_columns),
            partial(raised, root=self._snapshot),
            self.warned.pending,
            self.watches,
        )
        if not in_columns:
            lane = Lane(request, *options)
        elif isinstance(env, SubEnvs) and not env.reward_shape:
            lane = ColumnLane(env, request, *options)
        else:
            return m.Value(False)
        if request.env in self.lanes:  # another runner has refused it
            self.forget_lane(self.lanes[request.env])
        self.lanes[request.env] = lane
        return m.Value(True)

    def forget_lane(self, lane: Lane) -> None:
        """Close a lane, after the client has closed it or its environment."""
        del self.lanes[lane.number]
        lane.close()

    def fetch_infos(self, request: m.FetchInfos) -> m.Message:
        """Returns the last step's infos, which did not fit into the slab."""
        lane = self.lanes.get(request.env)
        return m.Value({} if lane is None else lane.infos())

    def forget_ends(self, request: m.ForgetEnds) -> m.Message:
        """Forget which episodes ended in the last step, whose infos cannot be joined."""
        self._envs[request.env].forget_ends()
        return m.Value(None)

    def take_apart(self, request: m.TakeApart) -> m.Message:
        """Send each sub-environment's own infos from now on."""
        env = self._envs[request.env]
        env.apart, env.single = True, request.single
        return m.Value(None)

    def call(self, request: m.Call) -> m.Message:
        """``VectorEnv.call``."""
        results = _caller(self._envs[request.env])(request.name, *request.args, **request.kwargs)
        return m.Value(tuple(results) if isinstance(results, list) else results)

    def watch(self, request: m.Watch) -> m.Message:
        """``VectorEnv.call`` without arguments, and watch its result from now on; the result is
        None if no sub-environment has the attribute.
        """
        number, name = request.env, request.name
        if self.watches.begin(number, self._envs[number], name, None):
            return m.WatchDone((), True)
        called = self.call(m.Call(number, name, (), {}))
        values = called.value if isinstance(called, m.Value) else ()
        return m.WatchDone(values, self.watches.begin(number, self._envs[number], name, values))

    def set_attr(self, request: m.SetAttr) -> m.Message:
        """``VectorEnv.set_attr``."""
        env = self._envs[request.env]
        set_attr = _forwarded(env, "set_attr")
        if set_attr is not None:
            set_attr(request.name, list(request.values))
        else:
            setattr(env, request.name, request.values[0])
        return m.Value(None)

    def render(self, request: m.Render) -> m.Message:
        """``VectorEnv.render``."""
        return m.Value(self._envs[request.env].render())

    def get_one(self, request: m.GetOne) -> m.Message:
        """Returns an attribute of one sub-environment, or of the vector environment itself."""
        value = None if request.index is None else self._found(request)
        return m.Method() if callable(value) else m.Value(value)

    def call_one(self, request: m.CallOne) -> m.Message:
        """Calls a method of one sub-environment, or of the vector environment itself."""
        if request.index is None:
            return m.Value(None)
        return m.Value(self._found(request)(*request.args, **request.kwargs))

    def _found(self, request: m.GetOne | m.CallOne) -> Any:
        if request.index == m.ITSELF:
            return _own(self._envs[request.env], request.name)
        one, depth = self._one(request), request.depth
        env, index = self._envs[request.env], request.index
        if isinstance(env, SubEnvs) and depth in (0, -1) and index is not None:
            method = env.freezing_method(index, request.name)
            if method is not None:
                return method
        if depth is None:
            return getattr(one.unwrapped, request.name)
        if depth < 0:
            return one.get_wrapper_attr(request.name)
        for _ in range(depth):
            one = one.env
        return getattr(one, request.name)

    def _one(self, request: m.GetOne | m.CallOne) -> Any:
        try:
            return _own(self._envs[request.env], "envs")[request.index]
        except AttributeError:
            kind = type(self._envs[request.env]).__qualname__
            raise AttributeError(
                f"a {kind} shows no sub-environments; use get_attr or call, which return one value "
                "for each"
            ) from None

    def get_random(self, request: m.GetRandom) -> m.Message:
        """Returns the states of the sub-environments' generators, or of the only generator."""
        own = self._generators.setdefault(request.env, generators.Generators())
        return m.Value(own.states(self._envs[request.env]))

    def set_random(self, request: m.SetRandom) -> m.Message:
        """Set the generators to other states, or replace them."""
        put = generators.replace if request.new else generators.bring
        put(self._envs[request.env], request.states)
        return m.Value(None)

    def close(self, request: m.Close) -> m.Message:
        """``VectorEnv.close``."""
        # In this order: whatever the repository's own ``close`` does, the environment is forgotten
        # by then.
        env = self._envs.pop(request.env, None)
        self._generators.pop(request.env, None)
        self._first_spaces.pop(request.env, None)
        self.watches.forget(request.env)
        if request.env in self.lanes:
            self.forget_lane(self.lanes[request.env])
        if env is not None:
            try:
                env.close()
            except BaseException as error:  # the environment is closed nevertheless
                told = traceback.format_exception_only(type(error), error)[-1].strip()
                warnings.warn(f"its close raised {told}", RuntimeWarning, stacklevel=2)
        return m.Value(None)


def _declared_spaces(env: Any) -> Iterator[list[Any]]:
    """Yields each sub-environment's observation and action space; of a repository's own vector
    class its single ones, and None in place of what is no space.
    """
    if isinstance(env, SubEnvs):
        yield from ([sub.observation_space, sub.action_space] for sub in env.envs)
        return
    names = "single_observation_space", "single_action_space"
    declared = (getattr(env, name, None) for name in names)
    yield [space if isinstance(space, gym.Space) else None for space in declared]


class _FirstSpaces(NamedTuple):
    """The first sub-environment's spaces, or the single ones, and the generators of their parts.
    ``acting``: the bit generators of the action space that Gymnasium made, each with its state.
    """

    spaces: list[Any]
    generators: list[Any]
    acting: list[tuple[Any, Any]]


def _first_spaces(env: Any) -> _FirstSpaces:
    spaces = next(_declared_spaces(env))
    seen, acting = (
        [getattr(node, "_np_random", None) for node in seeded_nodes(space)] for space in spaces
    )
    bits = [getattr(generator, "bit_generator", None) for generator in acting]
    states = [(each, each.state) for each in bits if isinstance(each, np.random.PCG64)]
    return _FirstSpaces(spaces, seen + acting, states)


def _call_own(env: Any, method: str, *args: Any, **kwargs: Any) -> Any:
    """Calls a method of the repository's own vector environment."""
    try:
        return getattr(env, method)(*args, **kwargs)
    except (IndexError, KeyError, TypeError, ValueError) as error:
        told = misfit_in_vector(error, env, method)
        if told is error:
            raise
        raise told from None


def _restored(env: Any, actions: Any) -> Any:
    """Gives actions the classes that Gymnasium gives them."""
    single = getattr(env, "single_action_space", None)
    if single is None or not batches.restores(single):
        return actions
    batched = getattr(env, "action_space", None)
    if batched is not None and not batches.is_batch(batched, single, int(env.num_envs)):
        return batches.restore(batched, actions)
    return batches.restore_batch(single, actions)


def _stepping(env: Any) -> tuple[Callable[[Any], Any], Callable[[Any], tuple[Any, ...]]]:
    """Functions that step an environment, and make the fields of ``StepDone`` of the result."""
    if isinstance(env, SubEnvs):
        return (lambda actions: _results(env, env.run_step(actions))), tuple
    own = partial(_call_own, env, "step")
    return (lambda actions: own(_restored(env, actions))), partial(compat.step_result, env)


def _results(env: SubEnvs, pairs: Pairs) -> tuple[Any, ...]:
    batch, infos = env.batch, env.joined(pairs)
    return batch.observation(), batch.rewards, batch.terminations, batch.truncations, infos


def _caller(env: Any) -> Callable[..., Any]:
    """Returns ``env.call``; for a vector environment without it, a read of its own attribute."""
    forwarded = _forwarded(env, "call")
    if forwarded is not None:
        return forwarded

    def call(name: str, *args: Any, **kwargs: Any) -> Any:
        value = _own(env, name)
        return value(*args, **kwargs) if callable(value) else value

    return call


def _forwarded(env: Any, name: str) -> Callable[..., Any] | None:
    """Returns the outermost layer's method of this name: ``VectorWrapper`` forwards no ``call``."""
    for _ in range(_MOST_WRAPPERS):
        if hasattr(env, name):
            return getattr(env, name)  # type: ignore[no-any-return]
        env = getattr(env, "env", None)
    return None


def _own(env: Any, name: str) -> Any:
    try:
        return getattr(env, name)
    except AttributeError:
        return getattr(getattr(env, "unwrapped", env), name)


_WITH_INFOS = frozenset({m.Reset, m.Step, m.Revive, m.FetchInfos})
"""Whose replies have infos, of which one part must not lose the others."""
_HANDLERS: dict[type[m.Message], Callable[[Runner, Any], m.Message]] = {
    m.Load: Runner.load,
    m.LoadTask: Runner.load_task,
    m.Build: Runner.build,
    m.Reset: Runner.reset,
    m.Step: Runner.step,
    m.Revive: Runner.revive,
    m.Call: Runner.call,
    m.Watch: Runner.watch,
    m.SetAttr: Runner.set_attr,
    m.Render: Runner.render,
    m.GetOne: Runner.get_one,
    m.CallOne: Runner.call_one,
    m.GetRandom: Runner.get_random,
    m.SetRandom: Runner.set_random,
    m.Close: Runner.close,
    m.Attach: Runner.attach,
    m.FetchInfos: Runner.fetch_infos,
    m.ForgetEnds: Runner.forget_ends,
    m.TakeApart: Runner.take_apart,
    m.RaisedException: lambda runner, unreadable: unreadable,
}
