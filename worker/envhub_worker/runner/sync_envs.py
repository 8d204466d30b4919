"""The worker's own loop over plain sub-environments: ``SyncVectorEnv``, written into given memory.

Observations, rewards and flags go straight to where they are read: no stacking, no deep copy.
Everything but ``reset`` and ``step`` is ``SyncVectorEnv``'s own. The parity suite compares the two
bit by bit. Followed: ``gymnasium.vector.SyncVectorEnv`` 1.4.

``FreezingEnv`` is for LeRobot's rollouts, which step all sub-environments until the last one is
done and drop the later results of finished ones. Newer releases announce a rollout in the options
of ``reset``. From then on a finished sub-environment repeats its last transition, with reward 0,
until the next rollout is announced; it renders its last frame once. Followed:
``lerobot.envs.utils.FreezeAfterEpisodeEnd`` 0.6, whose results these are.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from operator import itemgetter
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from envhub_worker.protocol.messages.runner import NEW_ROLLOUT
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES
from envhub_worker.runner import returned
from envhub_worker.runner.foreign import old_gym
from envhub_worker.runner.gymnasium_compat import SyncBase
from envhub_worker.runner.state.copies import kept, taken
from envhub_worker.runner.state.shared_state import SharedState

_NUMBERS = (float, int, np.number, np.bool_)

Pairs = list[tuple[int, dict[Any, Any]]]
"""Infos with the index of their sub-environment, in the order in which they came."""
DRIVES = frozenset({"reset", "step", "render"})
"""What a ``FreezingEnv`` has of an environment."""


def announces_rollout(options: Any) -> bool:
    """Whether these options of a reset announce one of LeRobot's rollouts."""
    return isinstance(options, dict) and bool(options.get(NEW_ROLLOUT))


class FreezingEnv:
    """Wraps a sub-environment's ``reset``, ``step`` and ``render``: it freezes at the end.
    ``cut``: whether its episode died, so that it is frozen after its first reset.
    """

    def __init__(self, env: Any, *, cut: bool = False) -> None:
        self._env = env
        self._cut = cut
        self._last: Any = None  # the transition that ended the episode; None before it
        self._frame: Any = None  # the picture after it

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """Like ``Env.reset``; once frozen, returns the last observation and info instead."""
        if self._last is not None and not announces_rollout(options):
            return self._last[0], self._last[4]
        self._last = self._frame = None
        observation, info = self._env.reset(seed=seed, options=options)
        if self._cut:
            self._cut = False
            self._last = (observation, 0.0, False, True, info)
        return observation, info

    def step(self, action: Any) -> Any:
        """Like ``Env.step``; once frozen, returns the last transition instead."""
        if self._last is not None:
            return self._last
        result = self._env.step(action)
        observation, _, terminated, truncated, info = result
        if terminated or truncated:
            self._last = (observation, 0.0, terminated, truncated, info)
        return result

    def render(self) -> Any:
        """Like ``Env.render``; once frozen, renders an image once and repeats it."""
        if self._frame is not None:
            return self._frame
        frame = self._env.render()
        if self._last is not None and isinstance(frame, np.ndarray):
            self._frame = frame
        return frame


Store = Callable[[int, Any], None]


class Batch:
    """The memory for the results of one batch: its own arrays, or views of a slab.

    Attributes:
        rewards: float64 ``(count, *reward_shape)``.
        terminations, truncations: bool ``(count,)``.
        store: Writes a sub-environment's observation into its row.
        rows: A view of each sub-environment's row, for observations of its dtype and shape; None
            for each if the space is no array.
    """

    def __init__(self, space: gym.Space[Any], count: int, reward_shape: tuple[int, ...]) -> None:
        self._space = space
        self._count = count
        self._members: list[Any] = [None] * count  # observations of a space without a fixed layout
        self.rewards = np.zeros((count, *reward_shape))
        self.terminations = np.zeros(count, np.bool_)
        self.truncations = np.zeros(count, np.bool_)
        self.rows: list[Any] = [None] * count
        self._slots: list[tuple[list[Any], Store, list[Any]]] = []  # leaves, their writer, and rows
        self._slot = 0  # which of them is written now
        self._left: int | None = None  # a slot whose rows the next one begins with
        self._join: Any = concatenate.dispatch(type(space))  # its function for this space
        self._empty: Any = None  # what batches are made in, where there are no slots
        layout = slabs.observation_layout(space, count, 1)
        if layout is None:
            has_parts = isinstance(space, (spaces.Dict, spaces.Tuple))  # which may not fit
            self.store: Store = self._keep if has_parts else self._members.__setitem__
            self._empty = create_empty_array(space, n=count, fn=np.zeros)
        else:
            self.write_to([[np.zeros(leaf.shape, leaf.dtype) for leaf in layout.leaves]])

    def _keep(self, index: int, member: Any) -> None:
        for path, _, seen in returned.parts(self._space, member):
            raise ValueError(f"{seen} cannot be written into observation{path}")
        self._members[index] = member

    def write_to(self, slots: list[list[Any]]) -> None:
        """Write observations into these leaves from now on, one list of leaves per slot."""
        is_array = isinstance(self._space, ARRAY_SPACES)
        self._slots = []
        for leaves in slots:
            rows = [leaves[0][index, ...] if is_array else None for index in range(self._count)]
            self._slots.append((leaves, _writer(self._space, iter(leaves)), rows))
        self.choose(0)

    def choose(self, slot: int, *, carry: bool = False) -> None:
        """Write the next observations into another slot; ``carry`` copies the last ones there."""
        if slot != self._slot:
            self._left = self._slot
        self._slot = slot
        if carry:
            self.carry(0)
        _, self.store, self.rows = self._slots[slot]

    def carry(self, start: int) -> None:
        """Copy the rows from ``start`` on from the previous slot, if the slot has changed."""
        left, self._left = self._left, None
        if left is not None:
            for ours, theirs in zip(self._slots[self._slot][0], self._slots[left][0], strict=True):
                ours[start:] = theirs[start:]

    def stay(self) -> None:
        """Forget the previous slot, since all rows have been written."""
        self._left = None

    def observation(self) -> Any:
        """Returns the batched observation: views of arrays that the next step overwrites."""
        if self._slots:
            return slabs.assembler(self._space)(self._slots[self._slot][0])
        return self._join(self._space, self._members, self._empty)

    def members(self) -> list[Any]:
        """Returns each sub-environment's observation."""
        if not self._slots:
            return list(self._members)
        batched = batch_space(self._space, self._count)
        return list(batches.members(self._space, batched, self.observation(), self._count))


class SubEnvs(SyncBase):  # type: ignore[misc]
    """Plain sub-environments, stepped with ``SyncVectorEnv``'s semantics.

    Attributes:
        batch: The memory that ``reset`` and ``step`` write their results into.
        reward_shape: Shape of one sub-environment's reward; not ``()`` for multi-objective ones.
        sliced: Whether other processes hold the rest of the vector environment.
        apart: Whether each sub-environment's own infos are sent as they are, also if no other
            process holds a slice.
        single: Whether only the caller resets it, whatever the autoreset mode.
        driven: The objects to reset, step and render: ``envs``, or a ``FreezingEnv`` for each.
        integers: Which discrete parts of the last observation are Python ints. Only kept for a
            single environment (``_single``).
        reward: A tuple with the last reward if it is no number. Only kept for a single environment.
        shared: Checks, after each reset and step, the state that the process's sub-environments
            share; None if they may share it.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], Any]],
        autoreset_mode: str,
        sync: bool,
        *,
        sliced: bool = False,
        start: int = 0,
    ) -> None:
        super().__init__(env_fns, copy=False, autoreset_mode=autoreset_mode)
        # AsyncVectorEnv stacks vector rewards, SyncVectorEnv refuses them
        self.reward_shape = () if sync else _reward_shape(self.envs[0])
        self.batch = Batch(self.single_observation_space, self.num_envs, self.reward_shape)
        self.driven: Sequence[Any] = self.envs
        self._done = [False] * self.num_envs  # whose episodes are over: the next step resets them
        self._done_before = self._done  # before the last step, in case its infos cannot be joined
        self._flagged: list[int] = []  # whose flags are not both False
        self._mode = autoreset_mode
        self._sync = sync
        self._siblings = sync and self.num_envs > 1
        self.sliced = sliced
        self.apart = self.single = False
        self.integers: list[bool] = []
        self.shared: SharedState | None = None
        self.reward: tuple[Any, ...] = ()
        self._start = start
        self._restores = batches.restores(self.single_action_space)
        self._plain_actions = isinstance(self.single_action_space, ARRAY_SPACES)

    def run_reset(self, seeds: Any, options: Any, mask: Any) -> Pairs:
        """Reset the sub-environments that the mask names, or all; returns the infos.

        Each gets its seed, if there are any, and the same options object. The mask is bool
        ``(num_envs,)`` or None; a shard's part of it may be all False.
        """
        chosen = range(self.num_envs) if mask is None else np.flatnonzero(mask).tolist()
        for index in chosen:
            self._done[index] = False
            self.batch.terminations[index] = self.batch.truncations[index] = False
        if self.driven is self.envs and announces_rollout(options):
            self.driven = [FreezingEnv(one) for one in self.envs]
        self._done_before = self._done
        infos: Pairs = []
        self.reward = ()
        copied = self._copier() if self._siblings else None
        for index in chosen:
            seed = None if seeds is None else seeds[index]
            result: Sequence[Any] = ()
            try:
                observation, info = self.driven[index].reset(seed=seed, options=options)
                result = (observation, info)
                self.batch.store(index, observation)
                if type(info) is not dict:
                    self._check_info(info)
                if info:
                    infos.append((index, copied(info) if copied else info))
            except Exception as error:
                self._refuse(error, index, "reset", result)
            if self._single:
                self.integers = batches.integers(self.single_observation_space, observation)
        if self.shared is not None:
            self.shared.look()
        return infos

    def run_revive(self, seeds: Any, rollout: bool = False) -> Pairs:
        """Reset all, in place of dead sub-environments whose episodes end; returns the infos.

        The episodes are truncated. The last observations died with the sub-environments: the new
        observations replace those, too. In a rollout they freeze there.
        """
        if rollout:
            self.driven = [FreezingEnv(env, cut=True) for env in self.envs]
        infos = self.run_reset(seeds, {NEW_ROLLOUT: True} if rollout else None, None)
        self.batch.rewards[...] = 0.0
        self.batch.truncations[...] = True
        self._flagged = list(range(self.num_envs))
        if self._same_step:
            fresh = batches.members(
                self.single_observation_space,
                self.observation_space,
                self.batch.observation(),
                self.num_envs,
            )
            finals = [(i, {"final_obs": row, "final_info": {}}) for i, row in enumerate(fresh)]
            return sorted([*finals, *infos], key=itemgetter(0))
        self._done = [not self.single] * self.num_envs
        return infos

    def run_step(self, actions: Any) -> Pairs:
        """Step every sub-environment, or reset it if its episode is over; returns the infos.
        Each sub-environment gets its row of the batch of actions unchanged.
        """
        batch, count = self.batch, self.num_envs
        store, rows, rewards = batch.store, batch.rows, batch.rewards
        dtype, shape = (None, None) if rows[0] is None else (rows[0].dtype, rows[0].shape)
        array = np.ndarray
        terminations, truncations = batch.terminations, batch.truncations
        for index in self._flagged:
            terminations[index] = truncations[index] = False
        flagged = self._flagged = []
        done = [False] * count
        copied = self._copier() if self._siblings else None
        infos: Pairs = []
        index, answered, over, again = 0, -1, False, -1
        each = self._each(actions)
        try:
            for index, env in enumerate(self.driven):
                action, over = next(each), self._done[index]  # past its end an array raises, slowly
                if over:
                    if self.resets_nothing:  # those before it have been stepped, as in Gymnasium
                        raise AssertionError(f"self._autoreset_envs={np.array(self._done)!r}")
                    observation, info = env.reset()
                    answered = index
                    rewards[index] = reward = 0.0
                else:
                    observation, reward, terminated, truncated, info = env.step(action)
                    answered = index
                    try:
                        rewards[index] = reward
                    except (TypeError, ValueError):
                        if not self._single:  # where it is sent as it is
                            raise
                    if terminated or truncated:
                        flagged.append(index)
                        terminations[index] = terminated
                        truncations[index] = truncated
                        if self._same_step:
                            infos.append((index, self._final(observation, info)))
                            again, answered = index, -1
                            observation, info = env.reset()
                            answered = index
                        else:
                            done[index] = not self.single
                if (
                    type(observation) is array
                    and observation.dtype is dtype
                    and observation.shape == shape
                ):
                    rows[index][...] = observation
                else:
                    store(index, observation)
                if type(info) is not dict:
                    self._check_info(info)
                if info:
                    infos.append((index, copied(info) if copied else info))
        except BaseException as error:
            batch.carry(index)  # who was not asked any more has his last observation still
            if again == index != answered:  # it is the reset that raised
                with contextlib.suppress(Exception):  # it does not fit, and is not the failure
                    store(index, observation)
            if not isinstance(error, Exception):
                raise
            method = "reset" if over or again == index else "step"
            result: Sequence[Any] = ()
            if answered == index:
                numbers = (0.0 if self._single else reward, terminated, truncated)
                result = (observation, *(() if method == "reset" else numbers), info)
            self._refuse(error, index, method, result)
        batch.stay()
        self._done_before, self._done = self._done, done
        if self._single:
            self.integers = batches.integers(self.single_observation_space, observation)
            self.reward = () if isinstance(reward, _NUMBERS) else (reward,)
        if self.shared is not None:
            self.shared.look()
        return infos

    @property
    def _same_step(self) -> bool:
        return self._mode == "SameStep" and not self.single

    @property
    def _single(self) -> bool:
        """Whether the client shows a single environment, whose results must keep their classes."""
        return self.apart and self.num_envs == 1 and not self.sliced

    @property
    def resets_nothing(self) -> bool:
        """Whether an ended episode stays ended until the caller asks for a reset."""
        return self._mode == "Disabled"

    def _check_info(self, info: Any) -> None:
        """Raise ``TypeError`` if ``VectorEnv._add_info`` cannot take an info."""
        empty = self._single and not info  # nothing is joined, and None says as much as {}
        if not empty and not hasattr(info, "items"):
            raise TypeError("the info is not a dict")

    def _refuse(
        self, error: Exception, index: int, method: str, result: Sequence[Any] = ()
    ) -> NoReturn:
        """Raise a call's error with an explanation, or an error about the result of the call."""
        env = self.envs[index]
        if result:
            declared = self.single_observation_space, self.reward_shape
            told = returned.misfit(error, env, method, self._start + index, result, *declared)
        else:
            told = old_gym.explained(error, env, method)
        if told is error:
            raise error
        raise told from None

    def render(self) -> Any:
        """Returns one frame per sub-environment."""
        return super().render() if self.driven is self.envs else self.call("render")

    def call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """Like ``SyncVectorEnv.call``, but frozen sub-environments repeat their last frame."""
        if name == "render" and self.driven is not self.envs and not (args or kwargs):
            return tuple(one.render() for one in self.driven)
        return super().call(name, *args, **kwargs)

    def freezing_method(self, index: int, name: str) -> Any:
        """Returns ``reset``, ``step`` or ``render`` of a ``FreezingEnv``; None without one."""
        freezes = self.driven is not self.envs and name in DRIVES
        return getattr(self.driven[index], name) if freezes else None

    def joined(self, pairs: Pairs) -> dict[Any, Any]:
        """Returns infos in the form in which they are sent: joined, or each sub-environment's own.

        A slice sends its own ones, because the first sub-environment with a key decides how values
        are joined, and that may be in another slice.
        """
        if not (self.apart or self.sliced):
            try:
                return batches.join_pairs(pairs, self.num_envs) if pairs else {}
            except Exception:
                self.forget_ends()
                raise
        infos = batches.flat_infos(pairs, self.num_envs)
        if infos is None:
            forms: Sequence[batches.Forms] = ()
            if not self.apart:
                # arrays lose their class, as in a column; a masked array would arrive as text
                pairs = [(index, taken(info)) for index, info in pairs]
                forms = [batches.forms_of(info) for _, info in pairs]
            infos = batches.own_infos(pairs, self.num_envs, forms)
        if any(self.integers):
            infos[batches.APART_SCALARS] = tuple(self.integers)
        if self.reward:
            infos[batches.APART_REWARD] = self.reward
        return infos

    def forget_ends(self) -> None:
        """Forget which episodes the last step ended, since its infos could not be joined:
        ``SyncVectorEnv`` notes them only after that.
        """
        if self._sync:
            self._done = self._done_before

    def _copier(self) -> Callable[[Any], Any]:
        """Returns a function that copies an info, since a sibling may fill the same object next."""
        return kept if self.apart else taken

    def _final(self, observation: Any, info: Any) -> dict[str, Any]:
        """Returns the final observation and info of an episode, before a reset may overwrite them.

        For a single environment both are copied. For several the copies are those of the class that
        the repository asked for: ``SyncVectorEnv`` copies ``final_info``, ``AsyncVectorEnv`` none,
        and has it first.
        """
        if self.apart:
            return {"final_obs": kept(observation), "final_info": kept(info)}
        if not self._sync:
            return {"final_info": info, "final_obs": observation}
        return {"final_obs": observation, "final_info": taken(info)}

    def _each(self, actions: Any) -> Iterator[Any]:
        if self._restores:
            actions = batches.restore_batch(self.single_action_space, actions)
        if self._plain_actions:
            return iter(actions)
        if self.single:
            return iter((batches.only(self.single_action_space, actions),))
        spaces = self.single_action_space, self.action_space
        return iter(batches.members(*spaces, actions, self.num_envs))


def _reward_shape(env: Any) -> tuple[int, ...]:
    """Returns the shape of ``reward_space``, which MO-Gymnasium's environments declare."""
    try:
        return tuple(env.get_wrapper_attr("reward_space").shape)
    except (AttributeError, TypeError):
        return ()


def _writer(space: gym.Space[Any], leaves: Iterator[Any]) -> Store:
    """Returns a function that writes a member of the space into row ``index`` of the leaves."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        parts: Any = space.spaces
        items = parts.items() if isinstance(space, spaces.Dict) else enumerate(parts)
        writers = [(key, _writer(sub, leaves)) for key, sub in items]

        def write_parts(index: int, member: Any) -> None:
            for key, write in writers:
                write(index, member[key])

        return write_parts
    return _leaf_writer(next(leaves))


def _leaf_writer(rows: Any) -> Store:
    dtype, shape = rows.dtype, rows.shape[1:]
    each = [rows[index, ...] for index in range(len(rows))]

    def write(index: int, member: Any) -> None:
        if type(member) is np.ndarray and member.dtype is dtype and member.shape == shape:
            each[index][...] = member
        else:  # the casts that SyncVectorEnv permits, and its errors for the others
            np.stack([member], out=rows[index : index + 1])

    return write
