"""Building an environment in a jail: a slice of it in each runner, and the fast lane to them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NoReturn

from envhub_sandbox.errors import LoadError, RemoteProtocolError, WorkerDiedError
from envhub_sandbox.session.jail_sources import JailSource, SharedJail
from envhub_sandbox.session.launcher import LoadedJail
from envhub_sandbox.transport.connection import SESSION
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import typed
from envhub_sandbox.transport.shared_memory.lane import FastLane, deposit
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest import EnvManifest, decode_env

Bounds = list[tuple[int, int]]
_numbers = itertools.count(1)


@dataclass(frozen=True)
class Place:
    """Where an environment lives.

    Attributes:
        loaded: Its jail.
        runners: One for each shard.
        number: What it is called there.
        lane: The way of its steps, where there is a fast one.
    """

    loaded: LoadedJail
    runners: list[int]
    number: int
    lane: FastLane | None


class Builder:
    """Builds one environment, as often as that is needed.

    Args:
        jails: Where its jails come from.
        manifest: What the environment is expected to be.
        bounds: The slices of the sub-environments, one for each shard.
    """

    def __init__(self, jails: JailSource, manifest: EnvManifest, bounds: Bounds) -> None:
        self._jails = jails
        self._repository = jails.repository
        self._manifest = manifest
        self._bounds = bounds
        # runners of a jail that several environments share die with it, for all of them
        own = not isinstance(jails, SharedJail)
        self._own = own
        self._keeps = own and jails.repository.policy.restart == "transparent"
        self._number = next(_numbers)  # in every jail: what was packed for one, another understands

    def build(self, loaded: LoadedJail, deadline: Deadline) -> Place:
        """Build all of it in a loaded jail.

        Raises:
            LoadError: ``make_env`` returned something else than before.
            WorkerError: The jail died, or took too long.
        """
        self._check_manifest(loaded)
        if self._keeps and not loaded.jail.kept:
            loaded.jail.keep(deadline)
        idle_s = self._repository.timeouts.idle_s
        if idle_s is not None and idle_s < float("inf"):
            loaded.jail.expire(idle_s, deadline)
        runners = self._repository.spread(loaded, len(self._bounds), deadline, self._manifest)
        self._check_manifest(loaded)
        place = Place(loaded, runners, self._number, None)
        shards = range(len(runners))
        self._build(place, shards, deadline)
        return replace(place, lane=self._open_lane(place, deadline))

    def rebuild(self, place: Place, dead: Sequence[int], deadline: Deadline) -> Place:
        """Build some shards again, each in a fresh runner in the same jail.

        Raises:
            LoadError, RemoteEnvError: The repository failed this time.
            WorkerError: They died again, or took too long.
        """
        jail, runners = place.loaded.jail, list(place.runners)
        gone = [runners[index] for index in dead]
        fresh = jail.replace_runners(gone, deadline)
        place.loaded.loaded.difference_update(gone)
        for index, runner in zip(dead, fresh, strict=True):
            runners[index] = runner
        self._repository.load(place.loaded, fresh, deadline, self._manifest)
        self._check_manifest(place.loaded)
        place = replace(place, runners=runners)
        self._build(place, dead, deadline)
        if place.lane is not None:
            for index in dead:
                place.lane.renew(index)
            if not self._attach(place.lane, place, dead, deadline):
                raise RemoteProtocolError("a fresh runner refuses the fast lane that others take")
        return place

    def _build(self, place: Place, shards: Sequence[int], deadline: Deadline) -> None:
        wanted = self._manifest
        builds = [
            (
                place.runners[index],
                m.Build(place.number, wanted.suite, wanted.task, *self._bounds[index]),
            )
            for index in shards
        ]
        replies = place.loaded.jail.exchange("make_env", builds, deadline)
        for index, reply in zip(shards, replies, strict=True):
            self._check_built(typed(reply, m.Built), *self._bounds[index])

    def _check_built(self, reply: m.Built, start: int, stop: int) -> None:
        """Hold what was built against the manifest. Trust: input from the worker."""
        most = self._repository.policy.limits.elements
        built, wanted = decode_env(reply.manifest, max_elements=most), self._manifest
        count = stop - start if wanted.shardable else wanted.num_envs
        if built.num_envs != count or _kind(built) != _kind(wanted):
            self._refuse()

    def _open_lane(self, place: Place, deadline: Deadline) -> FastLane | None:
        """Agree with the runners on slabs and doorbells; None where frames have to serve."""
        server, manifest = place.loaded.server, self._manifest
        if server.fd_path is None or not manifest.shardable or self._repository.lane == "frames":
            return None
        if not self._own:
            return None  # a runner has one lane, and these environments share theirs
        copy = self._repository.copy
        lane = FastLane.for_spaces(manifest, self._bounds, server.process_fd, copy=copy)
        if lane is None:
            return None
        try:
            agreed = self._attach(lane, place, range(len(place.runners)), deadline)
        except BaseException:
            lane.close()
            raise
        if not agreed:
            lane.close()
        return lane if agreed else None

    def _attach(
        self, lane: FastLane, place: Place, shards: Sequence[int], deadline: Deadline
    ) -> bool:
        jail, path = place.loaded.jail, place.loaded.server.fd_path
        assert path is not None
        for index in shards:
            shard, runner = lane.shards[index], place.runners[index]
            try:
                pidfd = deposit(path, SESSION, jail.number, runner, shard.fds)
            except OSError as error:  # the runner has gone, or the server
                text = "the worker process died before its first request"
                raise WorkerDiedError(text, request="make_env") from error
            lane.watch_runner(index, pidfd)
            shard.handed_over()
        messages = [
            (place.runners[index], lane.attach_message(place.number, index)) for index in shards
        ]
        replies = jail.exchange("attach", messages, deadline)
        return all(typed(reply, m.Value).value is True for reply in replies)

    def _check_manifest(self, loaded: LoadedJail) -> None:
        key = (self._manifest.suite, self._manifest.task)
        found = next((e for e in loaded.manifest.envs if (e.suite, e.task) == key), None)
        if found is None or loaded.changed or _shape(found) != _shape(self._manifest):
            self._refuse()

    def _refuse(self) -> NoReturn:
        self._jails.forget_manifest()
        key = (self._manifest.suite, self._manifest.task)
        raise LoadError(
            f"make_env returned another environment for {key} than before: its result must "
            "not change between calls. The remembered description has been dropped; call "
            "make_env again"
        )


def _shape(manifest: EnvManifest) -> tuple[Any, ...]:
    return (manifest.num_envs, manifest.shardable, *_kind(manifest))


def _kind(manifest: EnvManifest) -> tuple[Any, ...]:
    """What a slice has in common with the whole."""
    return (
        manifest.autoreset_mode,
        manifest.single_observation_space,
        manifest.single_action_space,
    )
