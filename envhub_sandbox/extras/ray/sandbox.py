"""``sandbox="ray"``: a worker server on a node of a Ray cluster, for each worker of a ``make_env``.

Ray places an actor, which starts an ``envhub-worker listen`` beside it (``actor.py``). The client
then uses it as a server on another host: it uploads the repository's files, and steps travel over
ZeroMQ with CURVE keys. Ray carries only the two public keys. Client and server each keep their
secret key, which they make for this actor.
"""

from __future__ import annotations

import ipaddress
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, cast
from urllib.parse import urlsplit

from envhub_sandbox.errors import PolicyError, WorkerStartupError
from envhub_sandbox.extras.ray import cluster
from envhub_sandbox.extras.ray.cluster import PlacedActor
from envhub_sandbox.extras.remote import sandbox as remote
from envhub_sandbox.extras.remote.repository import ServerPackages, UploadedRepository
from envhub_sandbox.extras.remote.tcp import TcpServer, new_keys
from envhub_sandbox.sandboxes.pool import ServerPool, ServerUse, WorkerServer
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.keys import parse_key
from envhub_worker.protocol.runtime import OWN, Runtime

_NODE_CHARS = 12
_MOST_GPUS = 1 << 16
_KEPT_S = 60.0
"""Seconds for which a server that has made packages stays idle, until a jail needs them."""
_FATE_S = 30.0
"""Seconds for which an error waits for Ray's reason: Ray notices a lost node after some 20 s."""


@dataclass(kw_only=True, eq=False)
class RaySandbox(Sandbox):
    """Workers on a Ray cluster. ``sandbox="ray"`` is this with its defaults.

    Each of ``num_workers`` has a worker server of its own, in an actor that Ray places by these
    options; without ``num_workers`` there is one server. An unused server serves the next
    ``make_env`` with the same object. Ray only counts the resources of an actor, whose processes
    include the server's; ``Limits`` enforces limits.

    Attributes:
        num_cpus: CPUs that Ray reserves for each actor; fractions are permitted.
        num_gpus: GPUs that Ray reserves for each actor; a policy with ``gpu=True`` grants the GPUs
            that Ray assigns.
        resources: Custom resources that Ray reserves for each actor, as in ``{"simulator": 1}``.
        scheduling_strategy: ``"SPREAD"`` uses the nodes in turn, ``"DEFAULT"`` fills some first;
            or one of Ray's objects, such as
            ``ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy``.
        runtime_env: Ray's runtime environment, as in ``{"pip": ["envhub-sandbox[ray]"]}``.
        address: As in ``ray.init``, for a process that has not called it; by default a running
            cluster, otherwise a local one.
        placement_s: Seconds to wait until Ray has placed and started the server. A cluster that
            scales itself may need minutes.
        shared: Use one server for all environments of this process that use this object, and for
            all their workers.
        heartbeat_s: As in ``RemoteSandbox``.
    """

    num_cpus: float = 1.0
    num_gpus: float = 0.0
    resources: Mapping[str, float] | None = None
    scheduling_strategy: Any = "SPREAD"
    runtime_env: Mapping[str, Any] | None = None
    address: str = ""
    placement_s: float = 300.0
    shared: bool = False
    heartbeat_s: float = 30.0
    name = "ray"
    _orders: dict[str, m.NeedPackages] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        numbers = {"num_cpus": self.num_cpus, "num_gpus": self.num_gpus, **(self.resources or {})}
        for option, value in numbers.items():
            if not (0 <= value < math.inf):
                raise PolicyError(f"RaySandbox: {option} is {value!r}; it takes 0 or more")
        for option in ("placement_s", "heartbeat_s"):
            value = getattr(self, option)
            if not value > 0:
                raise PolicyError(f"RaySandbox: {option} is {value!r}; it takes seconds above 0")

    def workers(self, num_workers: int | None) -> list[RaySandbox]:
        """See ``Sandbox``: each worker has its own server, unless ``shared``; Ray chooses nodes."""
        return [self] * (1 if self.shared else num_workers or 1)

    def __reduce__(self) -> Any:
        """Pickle only the arguments: the servers belong to this process."""
        kept = {option.name: getattr(self, option.name) for option in fields(self) if option.init}
        return _made, (kept,)

    def for_repository(
        self, snapshot: Path, policy: Policy, runtime: Runtime, assets: tuple[Path, ...] = ()
    ) -> RayRepository:
        """Return the sandbox for one repository. Starts nothing, and connects to nothing.
        Raises ``PolicyError``: the policy asks for something that no node can give;
        ``SandboxUnavailableError``: Ray is not installed.
        """
        cluster.check_installed()
        remote.check_policy(policy, runtime)
        if policy.gpu and not self.num_gpus:
            raise PolicyError("a policy with gpu=True needs RaySandbox(num_gpus=...)")
        if not isinstance(policy.gpu, bool):
            raise PolicyError(
                f"gpu={list(policy.gpu)} names GPUs of one machine, and Ray chooses the node: use "
                "gpu=True, which grants those that Ray assigns, with RaySandbox(num_gpus=...)"
            )
        order = self._orders[runtime.packages] if runtime.packages else None
        return RayRepository(snapshot, order, runtime.packages, self)

    def package_target(self) -> ServerPackages:
        """See ``Sandbox``: a server makes the packages on its node, and then serves its jails."""
        return ServerPackages(lambda: self.server_for(None, _KEPT_S), self._orders)

    def server_for(
        self, repository: RayRepository | None, idle_s: float | None
    ) -> ServerUse[RayServer]:
        """Acquire a server; starts one if there is none. Raises as ``RayServer``."""
        group = None if self.shared else repository
        return SERVERS.acquire(self, partial(_placed, self), idle_s, group)

    def placement(self) -> dict[str, Any]:
        """Return the arguments of ``ActorClass.options``, by which Ray places an actor."""
        wanted = {
            "num_cpus": self.num_cpus,
            "num_gpus": self.num_gpus,
            "resources": None if self.resources is None else dict(self.resources),
            "scheduling_strategy": self.scheduling_strategy,
            "runtime_env": None if self.runtime_env is None else dict(self.runtime_env),
        }
        return {option: value for option, value in wanted.items() if value is not None}


def _made(given: dict[str, Any]) -> RaySandbox:
    return RaySandbox(**given)


@dataclass(eq=False)
class RayRepository(UploadedRepository):
    """The sandbox of one repository for one worker: its environments share a server."""

    name = "ray"
    options: RaySandbox
    _node: str = field(default="", init=False)

    @property
    def address(self) -> str:
        """See ``Sandbox``: the node of the last server; before the first one ``"ray"``."""
        return f"Ray's node {self._node}" if self._node else self.name

    def runs_on(self, runtime: Runtime) -> Runtime:
        """See ``Sandbox``: names the cluster, the ``runtime_env``, and the packages made there."""
        prepared = json.dumps(self.options.runtime_env, sort_keys=True, default=repr)
        where = cluster.name(self.options.address)
        return Runtime(f"{where}, {prepared}{self.packages and f' {self.packages}'}")

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> ServerUse[RayServer]:
        """Acquire the repository's server; Ray places and starts one if there is none."""
        use = self.options.server_for(self, idle_s)
        self._node = use.server.node[:_NODE_CHARS]
        return use

    def prepare(
        self, order: m.OpenJail, server: WorkerServer, client: WorkerConnection, deadline: Deadline
    ) -> m.OpenJail:
        """Upload the files, and grant only the GPUs that Ray has assigned."""
        order = super().prepare(order, server, client, deadline)
        if not order.confinement["gpu"]:
            return order
        gpus = cast("RayServer", server).gpus
        return m.replace(order, confinement={**order.confinement, "gpu": gpus})


class RayServer(remote.RemoteServer):
    """A worker server on a node, which lives as long as its actor.

    Attributes:
        node: The node's id, in hexadecimal digits.
        gpus: The indices of the node's GPUs that Ray has assigned.

    Raises as ``cluster.connect`` and ``PlacedActor.start``.
    """

    is_ours = True

    def __init__(self, options: RaySandbox) -> None:
        cluster.connect(options.address)
        self._actor = PlacedActor(options.placement())
        try:  # interruption.md, rule 4
            ours = TcpServer(None, new_keys()[1], options.heartbeat_s, why_ended=self._why_ended)
            reply = self._actor.start(ours.public_key(), options.placement_s)
            endpoint, key, self.node, self.gpus = read_started(reply)
            super().__init__(endpoint, replace(ours, server_key=key))
            self._actor.watch(self._wake)
        except BaseException:
            self._actor.kill()
            raise

    def _why_ended(self) -> str:
        node = self.node[:_NODE_CHARS]
        return f". It was on Ray's node {node}: {self._actor.end_text(_FATE_S)}"

    @property
    def runs(self) -> bool:
        """See ``PlacedActor.runs``."""
        return self._actor.runs

    def stop(self) -> None:
        """See ``WorkerServer``: close the open jails, and end the actor, with which the server
        ends.
        """
        if not self._owner.is_here:
            return
        if not self.runs:
            self._wake()  # an ended server answers no more: end the waits for it
        super().stop()
        self._actor.kill()


def _placed(options: RaySandbox) -> RayServer:
    SERVERS.stop_idle()  # idle servers may hold the resources that this one needs
    return RayServer(options)


SERVERS: ServerPool[RayServer] = ServerPool()
RAY = RaySandbox()
"""The sandbox of ``sandbox="ray"``."""


def _is_gpu(number: object) -> bool:
    return type(number) is int and 0 <= number < _MOST_GPUS


def read_started(said: Mapping[str, Any]) -> tuple[str, bytes, str, tuple[int, ...]]:
    """Read an actor's answer about its server: endpoint, public key, node, GPUs.

    Trust: input from a node. Raises ``WorkerStartupError``: the answer is invalid.
    """
    try:
        endpoint, key, node, gpus = (said[name] for name in ("endpoint", "key", "node", "gpus"))
        parts = urlsplit(endpoint)
        ipaddress.ip_address(parts.hostname or "")
        good = parts.scheme == "tcp" and endpoint == f"tcp://{parts.netloc}" and parts.port
        good = good and "@" not in endpoint and endpoint.isascii() and endpoint.isprintable()
        good = good and type(node) is str and 0 < len(node) <= 64 and node.isascii()
        if good and node.isalnum() and type(gpus) is list and all(map(_is_gpu, gpus)):
            return endpoint, parse_key(key), node, tuple(gpus[:64])
    except (AttributeError, LookupError, TypeError, ValueError):
        pass
    raise WorkerStartupError("an actor on a node of Ray has not started a worker server")
