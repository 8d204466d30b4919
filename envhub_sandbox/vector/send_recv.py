"""``send`` and ``recv``: step some of the sub-environments, with several steps in flight."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import VectorEnv

from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.system import extras
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.vector.actions import action_reader, reset_message, seeds_for_all
from envhub_sandbox.vector.tracebacks import short_traceback
from envhub_worker.protocol.manifest.manifest import EnvManifest

_IN_FLIGHT = "envhub_sandbox.extras.several_workers.in_flight"


class Received(NamedTuple):
    """Results of ``n`` sub-environments, in the order of their ids.

    Attributes:
        observations: ``(n, *single_observation_space.shape)``.
        rewards: float64 ``(n,)``; 0 after a reset.
        terminations, truncations: bool ``(n,)``; False after a reset.
        infos: As in ``step``, with ``n`` rows. If workers return different dtypes or shapes for a
            key, its value is an object array.
        env_ids: int64 ``(n,)``, ascending.
    """

    observations: Any
    rewards: Any
    terminations: Any
    truncations: Any
    infos: dict[Any, Any]
    env_ids: Any


class SendRecv(VectorEnv[Any, Any, Any]):
    """The methods of a ``SandboxVectorEnv`` for requests in flight, which Gymnasium lacks."""

    def __init__(self, session: EnvSession) -> None:
        self._session = session
        self._requests = session.requests
        self._manifest = session.manifest
        self._readers: dict[int, Callable[[Any], Any]] = {}
        vars(self).pop("_flight", None)  # an ``InFlight``, once it is needed, of this session
        self.num_envs = session.manifest.num_envs

    @short_traceback
    def send(self, actions: Any, env_ids: Any = None) -> None:
        """Send actions to some sub-environments; ``recv`` returns the results.

        A worker steps all of its sub-environments together, so ``env_ids`` must have all or none of
        them. With ``make_env(..., min_ready=...)`` each sub-environment has a worker of its own;
        with ``num_workers`` workers share them.

        May be called again before the results are received, up to sixteen times for each
        sub-environment, which takes the actions one after the other.

        Args:
            actions: A batch of ``n`` actions, in the order of ``env_ids``.
            env_ids: Numbers of sub-environments: integers ``(n,)``, each at most once; None for
                all.

        Raises:
            ActionError: A wrong shape, dtype or id; nothing was sent.
            AlreadyPendingCallError: Another request is pending, or sixteen steps are.
            WorkerError: A worker has died or is late; nothing was sent. ``env_ids`` of the error
                are its sub-environments: send to others, or restart it by ``send_reset``.
        """
        with self._requests.use.flight:
            flight = self._in_flight()
            rows = flight.rows(env_ids)
            self._send_draws()
            count = len(rows.named)
            if count not in self._readers:
                self._readers[count] = action_reader(self._manifest, count)
            flight.send(rows, self._readers[count](actions))

    @short_traceback
    def send_reset(
        self,
        env_ids: Any = None,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        """Send a reset to some sub-environments; ``recv`` returns its results, with rewards of 0.

        A worker that has died or is late is first restarted, as by ``reset``.

        Args:
            env_ids: As in ``send``; nothing may be pending for them.
            seed: One seed (sub-environment ``i`` gets ``seed + i``), one for each of ``env_ids``,
                or None.
            options: Passed to each sub-environment.

        Raises: As ``send``.
        """
        if "reset_mask" in (options or {}):
            raise ValueError(
                "`send_reset` takes no `reset_mask`: name sub-environments by `env_ids`"
            )
        with self._requests.use.flight:
            flight = self._in_flight()
            rows = flight.rows(env_ids)
            seeds = _seeds_of(rows.named, seed, self._manifest)
            self._send_draws()
            flight.send_reset(rows, reset_message(self._manifest, seeds, options))

    @short_traceback
    def recv(self, min_ready: int | None = None, timeout: float | None = None) -> Received:
        """The results of the first sub-environments that are ready.

        Takes the results of whole workers, in the order in which they became ready, until there are
        ``min_ready`` sub-environments, or no more results to come. Other results stay for the next
        call. Infos and autoreset are as in ``step``.

        Args:
            min_ready: How many sub-environments to wait for; by default the value given to
                ``make_env``, otherwise all.
            timeout: Seconds to wait, also for another thread's ``recv``, or None for no limit. Each
                step also has ``Timeouts.step_s``.

        Returns:
            ``observations, rewards, terminations, truncations, infos, env_ids``, each with ``n``
            rows in the order of ``env_ids``: observations ``(n, *single_observation_space.shape)``,
            rewards float64 ``(n,)``, both flags bool ``(n,)``, ``env_ids`` int64 ``(n,)`` and
            ascending.

        Raises:
            NoAsyncCallError: Nothing was sent.
            ValueError: ``min_ready`` is less than one worker has, and there is no other.
            WorkerTimeoutError: ``timeout`` has passed, and nothing is lost; or the step of one
                worker took longer than ``Timeouts.step_s``.
            WorkerDiedError: The process of a worker ended.
            RemoteEnvError: A sub-environment raised; it is still usable.

        The last three have the worker's sub-environments in ``env_ids``, and no further result
        comes for these. The others continue, and the next call has their results.
        """
        wanted = self._session.repository.min_ready if min_ready is None else min_ready
        if wanted is not None and wanted < 1:
            raise ValueError(f"`min_ready` is {wanted}, and must be at least 1")
        deadline, flight = Deadline(timeout), self._in_flight()
        with flight.held_in_time(deadline):
            received: Received = flight.recv(self.num_envs if wanted is None else wanted, deadline)
            self._requests.note_answered()
            return received

    def _send_draws(self) -> None:
        """Send the caller's draws before anything is in flight; later no request may be sent."""
        if self._requests.before_request is not None and self._requests.waiting is None:
            self._requests.before_request()

    def _in_flight(self) -> Any:
        flight = vars(self).get("_flight")
        if flight is None:
            in_flight = extras.required(_IN_FLIGHT, "InFlight", "send and recv")
            parts = getattr(self._session, "parts", [self._session])
            # without a lock, for which ``recv`` would wait longer than its timeout
            flight = vars(self).setdefault("_flight", in_flight(self._requests, parts))
        return flight


def _seeds_of(named: list[int], seed: Any, manifest: EnvManifest) -> Any:
    """A list with a seed or None for every sub-environment; only those of ``named`` are used."""
    if seed is None or isinstance(seed, (int, np.integer)):
        return seeds_for_all(seed, manifest)
    seeds = list(seed)
    if len(seeds) != len(named):
        raise ValueError(f"`seed` has {len(seeds)} entries for {len(named)} sub-environments")
    by_id = dict(zip(named, seeds, strict=True))
    return seeds_for_all([by_id.get(index) for index in range(manifest.num_envs)], manifest)
