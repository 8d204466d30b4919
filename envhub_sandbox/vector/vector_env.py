"""Gymnasium's ``VectorEnv`` for an environment that lives in a jail. Knows no sockets.

Followed: ``gymnasium.vector.AsyncVectorEnv`` for the calls and their errors, ``SyncVectorEnv`` for
the results.
"""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy, deepcopy
from functools import partial
from threading import get_ident
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv

from envhub_sandbox.errors import RemoteEnvError
from envhub_sandbox.session.requests import SENT, MessageFor, for_every_shard
from envhub_sandbox.system.log import warn_caller
from envhub_sandbox.system.platform import OwnerProcess
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.results import Own, StepResult
from envhub_sandbox.transport.values import not_here, seeds
from envhub_sandbox.vector.actions import action_reader, check_mask, reset_message, seeds_for_all
from envhub_sandbox.vector.generators import SAID_NEXT, Generators
from envhub_sandbox.vector.sandbox_view import SandboxView
from envhub_sandbox.vector.send_recv import SendRecv
from envhub_sandbox.vector.space_copies import SpaceCopies
from envhub_sandbox.vector.sub_environment import SubEnvironment
from envhub_sandbox.vector.tracebacks import RAISED, short_traceback, shortened
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.manifest.names import absent, is_servable

if TYPE_CHECKING:
    from envhub_sandbox.session.env_session import EnvSession
    from envhub_sandbox.session.repository import Recipe

_NOT_CALLED = frozenset({"reset", "step", "close"})
"""Methods that ``AsyncVectorEnv.call`` refuses: the vector environment has its own."""

_OURS = frozenset({"prewarm", "recv", "sandbox", "send", "send_reset"})
"""Public names that Gymnasium's vector environments do not have."""


class VectorApart(NamedTuple):
    """``reset`` (of seeds, options and a mask), ``step`` and ``step_wait`` with infos apart, and
    the functions of ``Results`` that read such infos.
    """

    reset: Callable[..., tuple[Any, dict[Any, Any]]]
    step: Callable[[Any], StepResult]
    step_wait: Callable[[], StepResult]
    own: Callable[[dict[Any, Any]], Own]
    each: Callable[[dict[Any, Any]], list[list[dict[Any, Any]]]]


# Gymnasium's class is a direct base, too, for libraries that check only direct bases (skrl)
class SandboxVectorEnv(SendRecv, VectorEnv[Any, Any, Any]):
    """A vector environment whose code runs in a confined process.

    It has all methods of ``VectorEnv``, and ``*_async`` and ``*_wait`` of ``AsyncVectorEnv``. The
    caller owns the returned arrays: they are writable, and no later step changes them. One thread
    at a time uses the environment; a second thread waits, with a ``RuntimeWarning`` if both step.
    Any thread may call ``close``.

    Attributes:
        num_envs: Number of sub-environments.
        closed: Whether ``close`` has been called.
        metadata: With ``"autoreset_mode"``, as in Gymnasium.
        sandbox: Its confinement, resource usage, denials and counters.
    """

    def __init__(self, session: EnvSession, again: Callable[[], EnvSession] | None = None) -> None:
        super().__init__(session)
        self._again = again  # makes another session after ``close``, for LeRobot
        self._owner = OwnerProcess()  # a fork must not close it
        manifest = self._manifest
        self._requests.face = type(self).__name__
        self._timeouts = session.repository.timeouts
        self._read_actions = action_reader(manifest, manifest.num_envs)
        self._generators = Generators(self._requests)
        self._first_spaces: dict[str, gym.Space[Any]] = {}  # if a reset has changed them
        self._spaces = SpaceCopies(manifest.single_observation_space, manifest.single_action_space)
        self._still: Any = None  # the last picture of the first sub-environment, for notebooks
        self.single_observation_space = manifest.single_observation_space
        self.single_action_space = manifest.single_action_space
        self.observation_space = manifest.observation_space
        self.action_space = manifest.action_space
        self.metadata = metadata_of(manifest, whole=session.repository.for_lerobot)
        self.render_mode = manifest.render_mode
        # as in Gymnasium, where a SyncVectorEnv has none
        has_spec = not manifest.shardable and manifest.spec is not None
        self.spec = self._spec_again(manifest.spec) if has_spec else None
        if manifest.shardable:  # a repository's own class has others, or none
            self.autoreset_mode = self.metadata.get("autoreset_mode")
            self.copy = session.repository.copy
            # the functions are in the sandbox; these replacements raise an error that says so
            made_there = partial(not_here, reference=session.repository.label)
            self.env_fns = [made_there] * manifest.num_envs
            self.observation_mode = "same"
        # processes end with the last reference to the proxy; interruption.md, rule 13
        self._finalizer = weakref.finalize(self, session.finalize)
        self._finalizer.atexit = False
        self._warn_of_hidden_names()

    def _warn_of_hidden_names(self) -> None:
        """Warn if the repository's vector environment has attributes that ours hide."""
        hidden = _OURS.intersection(self._manifest.attributes)
        if hidden:
            warn_caller(
                f"{self._session.repository.label}: its vector environment has attributes named "
                f"{', '.join(sorted(hidden))}, which are not served: "
                f"{self._requests.face} has its own",
                UserWarning,
            )

    @property
    def closed(self) -> bool:  # type: ignore[override]  # there is nothing to set
        """Whether ``close`` has been called."""
        return self._requests.closed

    @short_traceback
    def prewarm(self) -> None:
        """Start the processes now, in the background; returns at once.

        The first ``reset`` then waits only for the rest of the start. Otherwise processes start at
        the first request, so that a suite of many tasks costs nothing before its use. An
        evaluation can prewarm the next task while it plays one. If the start fails, the first
        request raises the error.
        """
        self._requests.refuse_if_closed()
        for prewarm in self._session.prewarms:
            prewarm.start_in_background()

    # --- reset and step ------------------------------------------------------------------------

    @short_traceback
    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all sub-environments, or those of ``options["reset_mask"]``.

        Args:
            seed: One seed (sub-environment ``i`` gets ``seed + i``), one each, or None.
            options: Passed to each sub-environment; ``"reset_mask"`` is bool ``(num_envs,)``.

        Returns:
            Batched observation ``(num_envs, *single_observation_space.shape)``, and infos.

        Raises:
            WorkerTimeoutError: It took longer than ``Timeouts.reset_s``; call it again.
            WorkerDiedError: The worker process ended.
            RemoteEnvError: The environment raised; it is still usable.
        """
        observation, infos = self._reset(seed, options)
        return observation, self._requests.results.joined(infos)

    def _reset(
        self, seed: Any, options: dict[str, Any] | None, mask: Any = None
    ) -> tuple[Any, dict[Any, Any]]:
        # Not by reset_async and reset_wait: an interrupt between them would leave `waiting` set,
        # and the next request refused, although no reset_wait can follow.
        self._note_first_use()
        with self._requests.use.flight, self._requests.use.lock:
            self._refuse_if_busy_for_reset(options if mask is None else {"reset_mask": mask})
            self._send_reset(seed, options, mask)
            return self._end_reset(self._timeouts.reset_s)

    @short_traceback
    def reset_async(
        self, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> None:
        """Send the reset; ``reset_wait`` returns its results."""
        self._note_first_use()
        with self._requests.use.flight, self._requests.use.lock:
            self._refuse_if_busy_for_reset(options)
            self._send_reset(seed, options)
            self._requests.waiting = "reset"

    def _note_first_use(self) -> None:
        """Note the first use before taking the lock, which a start ahead may hold for long."""
        self._open_again()
        for prewarm in self._session.prewarms:
            if prewarm.starting is not None and not self.closed:
                prewarm.note_use()

    def _open_again(self) -> None:
        """If it serves LeRobot, start again after a ``close``, with the same settings.

        A fork does not start again, since the server belongs to its parent.
        """
        if not (self.closed and self._again and self._session.repository.for_lerobot):
            return
        with self._requests.use.lock:
            if self.closed and self._owner.is_here:
                self._finalizer.detach()
                SandboxVectorEnv.__init__(self, self._again(), self._again)

    def _refuse_if_busy_for_reset(self, options: dict[str, Any] | None) -> None:
        """Refuse a reset while a request is pending; a reset of all drops those in flight."""
        if self._requests.waiting == SENT and "reset_mask" not in (options or {}):
            self._in_flight().drop()
        self._requests.refuse_if_busy("reset_async")

    def _send_reset(self, seed: Any, options: dict[str, Any] | None, mask: Any = None) -> None:
        if options is not None and "reset_mask" in options:
            options = copy(options)  # the caller's mapping keeps its mask
            mask = options.pop("reset_mask")
            check_mask(mask, self.num_envs)
        seeds = seeds_for_all(seed, self._manifest)
        try:
            self._session.recover()
        except BaseException as error:
            self._requests.explain(error)
            raise
        self._requests.show_warnings()
        self._requests.submit("reset", reset_message(self._manifest, seeds, options, mask))

    @short_traceback
    def reset_wait(self, timeout: float | None = None) -> tuple[Any, dict[str, Any]]:
        """The results of ``reset_async``; ``timeout`` in seconds, or ``Timeouts.reset_s``."""
        with self._requests.use.lock:
            self._requests.end_wait("reset")
            timeout_s = self._timeouts.reset_s if timeout is None else timeout
            observation, infos = self._end_reset(timeout_s)
        return observation, self._requests.results.joined(infos)

    def _end_reset(self, timeout_s: float | None) -> tuple[Any, dict[Any, Any]]:
        replies = self._requests.collect(timeout_s, m.ResetDone)
        done = self._requests.finish_reset(replies)
        if self._requests.attributes.take_seeded():
            self._follow_spaces()
        return done

    def _follow_spaces(self) -> None:
        """Have the single spaces draw as those that a reset has seeded, and note the present ones.
        Those of an ``AsyncVectorEnv`` belong to no sub-environment, unless it is shown as a single
        one.
        """
        if self._manifest.sync or self._requests.results.single:
            with suppress(*SAID_NEXT):
                for name in ("observation_space", "action_space"):
                    space = self.envs[0]._get(name)
                    if isinstance(space, gym.Space):
                        self._first_spaces[name] = space

    def step(self, actions: Any) -> StepResult:
        """Step every sub-environment.

        Args:
            actions: A batch for ``action_space``, as arrays, lists or torch tensors.

        Returns:
            observations ``(num_envs, *single_observation_space.shape)``, rewards float64
            ``(num_envs,)``, terminations and truncations bool ``(num_envs,)``, infos.

        Raises:
            ActionError: A wrong shape or dtype; nothing was sent.
            WorkerTimeoutError: It took longer than ``Timeouts.step_s``; call ``reset``.
            WorkerDiedError: The worker process ended.
            RemoteEnvError: The environment raised; it is still usable.
        """
        results = self._requests.results
        try:  # without decorator and step_async, for speed: no method is called more often
            done = self._step(actions)
            return (*done[:4], results.joined(done[4])) if results.apart else done
        except RAISED as error:
            if shortened(error):
                __tracebackhide__ = True  # pytest hides the frame then
                raise error  # ENVHUB_TRACEBACK=full shows where
            raise

    def _step(self, actions: Any) -> StepResult:
        requests = self._requests
        if requests.stepping is not None:
            requests.warn_of_two(get_ident())
        with requests.use.lock:
            try:
                requests.stepping = get_ident()
                if requests.closed or requests.waiting is not None:
                    requests.refuse_if_busy("step_async")
                requests.submit_step(self._read_actions(actions))
                return requests.collect_step(self._timeouts.step_s)
            finally:
                requests.stepping = None

    @short_traceback
    def step_async(self, actions: Any) -> None:
        """Send the actions; ``step_wait`` returns the results."""
        with self._requests.use.lock:
            self._requests.refuse_if_busy("step_async")
            self._requests.submit_step(self._read_actions(actions))
            self._requests.waiting = "step"

    @short_traceback
    def step_wait(self, timeout: float | None = None) -> StepResult:
        """The results of ``step_async``; ``timeout`` in seconds, or ``Timeouts.step_s``."""
        *done, infos = self._step_wait(timeout)
        return (*done, self._requests.results.joined(infos))

    def _step_wait(self, timeout: float | None = None) -> StepResult:
        with self._requests.use.lock:
            self._requests.end_wait("step")
            timeout_s = self._timeouts.step_s if timeout is None else timeout
            return self._requests.collect_step(timeout_s)

    # --- everything else -----------------------------------------------------------------------

    @short_traceback
    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method, or read an attribute, of every sub-environment: a tuple of results."""
        self._open_again()
        with self._requests.use.lock:
            self._requests.refuse_if_busy("call_async")
            if not (args or kwargs) and self._manifest.shardable:
                own = name == "np_random" and self._manifest.sync  # a request would return copies
                return cast("tuple[Any, ...]", self.np_random) if own else self._read(name)
            self._send_call(name, args, kwargs)  # not by call_async, as _reset says
            return self._end_call(self._timeouts.call_s)

    def _read(self, name: str) -> tuple[Any, ...]:
        """``call`` without arguments; attributes that are read after each step are watched."""
        attributes = self._requests.attributes
        values = attributes.get(name)
        if isinstance(values, RemoteEnvError):
            raise copy(values)
        if values is not None:
            return values
        return self._watched(name) if attributes.should_watch(name) else self._called(name)

    def _watched(self, name: str) -> tuple[Any, ...]:
        """Read an attribute, and have its value or its absence watched from now on."""
        attributes = self._requests.attributes
        self._send_call(name, (), {}, for_every_shard(m.Watch, name))
        replies = self._requests.collect(self._timeouts.call_s, m.WatchDone)
        watched = all(reply.watched for reply in replies)
        absent_in = [type(reply.value) is tuple and not reply.value for reply in replies]
        if any(absent_in):
            try:
                return self._called(name)
            except RemoteEnvError as error:
                attributes.put(name, copy(error), watched=watched and all(absent_in))
                raise
        values = self._requests.one_each("call", replies)
        attributes.put(name, values, watched=watched)
        return values

    def _called(self, name: str) -> tuple[Any, ...]:
        self._send_call(name, (), {})
        return self._end_call(self._timeouts.call_s)

    @short_traceback
    def call_async(self, name: str, /, *args: Any, **kwargs: Any) -> None:
        """Send the call; ``call_wait`` returns its results."""
        with self._requests.use.lock:
            self._requests.refuse_if_busy("call_async")
            self._send_call(name, args, kwargs)
            self._requests.waiting = "call"

    def _send_call(
        self,
        name: str,
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
        instead: MessageFor | None = None,
    ) -> None:
        _check_name(name)
        if name in _NOT_CALLED and not self._manifest.sync:
            raise ValueError(
                f"Trying to call function `{name}` with `call`, use `{name}` directly instead."
            )
        self._requests.submit("call", for_every_shard(m.Call, name, args, kwargs), instead)

    @short_traceback
    def call_wait(self, timeout: float | None = None) -> tuple[Any, ...]:
        """The results of ``call_async``; ``timeout`` in seconds, or ``Timeouts.call_s``."""
        with self._requests.use.lock:
            self._requests.end_wait("call")
            return self._end_call(self._timeouts.call_s if timeout is None else timeout)

    def _end_call(self, timeout_s: float | None) -> tuple[Any, ...]:
        replies = self._requests.collect(timeout_s, m.Value)
        if not self._manifest.shardable:
            return cast("tuple[Any, ...]", self._spaces.of(replies[0].value))
        values = self._requests.one_each("call", replies)
        # AsyncVectorEnv returns a new copy each time
        copies = self._spaces if self._manifest.sync else SpaceCopies()
        return cast("tuple[Any, ...]", copies.of(values))

    @short_traceback
    def get_attr(self, name: str) -> tuple[Any, ...]:
        """The values of an attribute, one for each sub-environment."""
        return self.call(name)

    @short_traceback
    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every sub-environment: one value each, or one for all."""
        _check_name(name)
        each = list(values) if isinstance(values, (list, tuple)) else [values] * self.num_envs
        if len(each) != self.num_envs:
            raise ValueError(
                "Values must be a list or tuple with length equal to the number of environments. "
                f"Got `{len(each)}` values for {self.num_envs} environments."
            )
        self._requests.ask(
            "set_attr",
            lambda number, bounds: m.SetAttr(number, name, tuple(each[bounds[0] : bounds[1]])),
        )

    @short_traceback
    def render(self) -> tuple[Any, ...] | None:
        """The renderings of the sub-environments; None if the vector environment returns None."""
        replies = self._requests.ask("render", for_every_shard(m.Render))
        if self._manifest.shardable:
            rendered = self._requests.one_each("render", replies)
        else:
            rendered = cast("tuple[Any, ...]", replies[0].value)
        self._still = rendered[0] if isinstance(rendered, tuple) and rendered else None
        return rendered

    @property
    @short_traceback
    def np_random(self) -> Any:
        """The generator of each sub-environment, or the only one of a repository's own class.

        A draw here advances the environment's generator, and the other way round. The generators of
        an ``AsyncVectorEnv`` are copies, as in Gymnasium.
        """
        generators = self._generators.read()
        if self._generators.single:
            return generators[0]
        return tuple(generators if self._manifest.sync else map(deepcopy, generators))

    @np_random.setter
    @short_traceback
    def np_random(self, value: Any) -> None:
        self._generators.read()
        if not self._generators.single:  # as in SyncVectorEnv
            raise AttributeError(
                "np_random is the generators of the sub-environments: set that of each, as in "
                "env.envs[0].np_random = generator"
            )
        self._generators.put(0, value)

    @property
    @short_traceback
    def np_random_seed(self) -> Any:
        """The seeds of the generators."""
        name = "np_random_seed"
        replies = self._requests.ask(name, for_every_shard(m.GetOne, m.ITSELF, 0, name))
        if type(replies[0].value) is not tuple:
            return seeds(replies[0].value)
        return seeds(self._requests.one_each(name, replies))

    @property
    def envs(self) -> list[SubEnvironment]:
        """A handle on each sub-environment, to read, to call, and to drive it by itself."""
        return [SubEnvironment(self, index) for index in range(self.num_envs)]

    @property
    def sandbox(self) -> SandboxView:
        """Confinement, resource usage, denials and counters of the environment.

        This is never the repository's attribute of this name, whose claims must not be taken for
        these; ``make_env`` warns if there is one. Behind a wrapper use ``env.unwrapped.sandbox``;
        a sub-environment's own attribute is ``env.envs[0].sandbox``.
        """
        return SandboxView(self._session)

    def close(self, **kwargs: Any) -> None:
        """Close the sub-environments and end their processes, in bounded time. Idempotent.

        Later requests are refused, but for LeRobot ``reset`` and ``call`` open it again.
        """
        if self._requests.waiting not in (None, SENT) and not self.closed:
            warnings.warn(
                f"Calling `close` while waiting for a pending call to `{self._requests.waiting}` "
                "to complete.",
                UserWarning,
                stacklevel=2,
            )
        self._requests.closed = True
        self._session.close()
        self._requests.show_warnings()

    def close_extras(self, **kwargs: Any) -> None:
        """Do nothing, since ``close`` does everything."""

    @short_traceback
    def __getattr__(self, name: str) -> Any:
        """An attribute of the repository's vector environment that Gymnasium's does not have."""
        manifest = self.__dict__.get("_manifest")
        # The manifest's names were checked, but Python also calls this method with the name of a
        # property of ours that raises AttributeError.
        ours = not is_servable(name) or hasattr(type(self), name)
        if manifest is None or ours or name not in manifest.attributes:
            raise absent(self, name, "get_attr")
        return SubEnvironment(self, m.ITSELF)._get(name)

    def __reduce__(self) -> tuple[Any, ...]:
        # Also for copy and deepcopy: a copy has processes of its own, since either may be closed.
        recipe = self._session.repository.recipe
        if recipe is None:
            raise TypeError(f"{self!r} does not know how it was made, so it cannot be pickled")
        key = self._manifest.suite, self._manifest.task
        if self._session.repository.for_lerobot:
            return _one_for_lerobot, (recipe, *key)
        return recipe.make_one, key

    def __repr__(self) -> str:
        return f"SandboxVectorEnv({self._session.repository.label}, num_envs={self.num_envs})"

    def _repr_html_(self) -> str:
        from envhub_sandbox.vector.html_repr import environment_html

        return environment_html(self, self.sandbox.report(), self._still)

    __html__ = _repr_html_

    def _spec_again(self, facts: dict[str, Any] | None) -> EnvSpec:
        recipe = self._session.repository.recipe
        return recipe.spec(self._manifest.suite, self._manifest.task, facts)

    def _apart(self, *, single: bool = False) -> VectorApart | None:
        """Have infos come apart from now on, for libraries of single environments. Returns None if
        a repository's own class joins them, or if the worker cannot be asked now.
        ``single``: also have nobody but the caller reset it, as the autoreset mode then says.
        """
        if not self._manifest.shardable:
            return None
        if not self._session.take_apart(Deadline(self._timeouts.call_s), single=single):
            return None
        results = self._requests.results
        if results.single:
            self.autoreset_mode = AutoresetMode.DISABLED
            self.metadata["autoreset_mode"] = AutoresetMode.DISABLED
        return VectorApart(self._reset, self._step, self._step_wait, results.own, results.each)


def serve_lerobot(env: SandboxVectorEnv) -> None:
    """Behave as LeRobot's lazy environments: ``reset`` after ``close`` opens it again, and
    ``render_fps`` is an integer.
    """
    env._session.repository.for_lerobot = True
    env.metadata = metadata_of(env._manifest, whole=True)


def _one_for_lerobot(recipe: Recipe, suite: str, task: int | str) -> SandboxVectorEnv:
    env: SandboxVectorEnv = recipe.make_one(suite, task)
    serve_lerobot(env)
    return env


def leave_suite(env: SandboxVectorEnv) -> None:
    """Have the first use start no other task of the suite, since ``EnvSuites.map`` starts them."""
    for prewarm in env._session.prewarms:
        prewarm.on_first_use(None, lambda: False)


def refuse_limit(env: SandboxVectorEnv, steps: int | None) -> None:
    """Raise ``ValueError`` if a limit of an episode's steps is not the repository's own."""
    own = env._spec_again(env._manifest.spec).max_episode_steps
    if steps not in (None, own):
        raise ValueError(
            f"{env}: max_episode_steps={steps} is not the repository's limit, {own}. Leave it out, "
            "or put a gymnasium.wrappers.TimeLimit around SandboxEnv"
        )


def metadata_of(manifest: EnvManifest, *, whole: bool = False) -> dict[str, Any]:
    """The metadata, with Gymnasium's enum for the autoreset mode. Trust: values from the worker.

    LeRobot writes videos with an integer ``render_fps``: 20.0 becomes 20, and with ``whole`` 12.5
    is rounded, too.
    """
    metadata = dict(manifest.metadata)
    rate = metadata.get("render_fps")
    if rate is not None and (whole or rate == int(rate)):
        metadata["render_fps"] = max(1, round(rate))
    mode = manifest.autoreset_mode
    if mode is None:
        return metadata
    return {**metadata, "autoreset_mode": AutoresetMode(mode)}


def _check_name(name: object) -> None:
    """Raise ``TypeError``, with Python's text, if an attribute's name is not a string."""
    if not isinstance(name, str):
        raise TypeError(f"attribute name must be string, not '{type(name).__name__}'")
