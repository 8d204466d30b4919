"""What tests and benchmarks see of the inside: the one place that knows private names.
A test asks for what it needs by the name of what it gets: ``inside.jail(env)``, and not by where
that lies today. When the packages are arranged anew this file is changed, and no test is. So a
test names nothing that starts with an underscore; ruff finds who does. What is missing
here is added here: a function, or a *spot*, which is an owner and a name, for
``monkeypatch.setattr(*inside.ending(env), interrupted)``."""

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zmq

from envhub_sandbox.extras.docker import container
from envhub_sandbox.extras.judge import denials, static
from envhub_sandbox.extras.judge.play import task, traces
from envhub_sandbox.extras.packages import environments, interpreters, modules, source
from envhub_sandbox.extras.packages.resolution import resolutions
from envhub_sandbox.extras.remote import sandbox as remote
from envhub_sandbox.extras.remote import tcp
from envhub_sandbox.factory import make_env
from envhub_sandbox.session import env_session
from envhub_sandbox.session import launcher as launcher_module
from envhub_sandbox.session.counters import Ledger
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.launcher import Launcher, LoadedJail
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.session.repository import Recipe, Repository
from envhub_sandbox.system import folders
from envhub_sandbox.transport import connection, output
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import JailHandle
from envhub_sandbox.transport.shared_memory.client_slabs import LaneShard
from envhub_sandbox.transport.shared_memory.lane import SharedMemoryLane
from envhub_worker.extras.access.audit.log import Log
from envhub_worker.extras.access.commands import listen, listen_options
from envhub_worker.extras.access.commands import status as status_command
from envhub_worker.extras.access.commands.identity import Identity
from envhub_worker.extras.access.curve_port import ConnectionLimiter
from envhub_worker.extras.access.remote_gate import RemoteGate
from envhub_worker.lockdown.limits import cgroups
from envhub_worker.lockdown.stages import runner as stages_runner
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.lifecycle import Lifecycle, State
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.messages import message, prefix
from envhub_worker.spawn.spawner import Spawner
from envhub_worker.supervisor import served_slabs

Spot = tuple[Any, str]

# --- one environment ---------------------------------------------------------------------------


def session(env: Any) -> EnvSession:
    """What lies behind the Gymnasium face of an environment."""
    return env._session


def parts(env: Any) -> list[EnvSession]:
    """The workers of an environment that is spread over several."""
    return env._session.parts


def leases(env: Any) -> list[Lease]:
    """Its hold on a jail, or that of each of its workers."""
    found = env._session
    return [part.lease for part in getattr(found, "parts", [found])]


def state(env: Any) -> State:
    return session(env).lifecycle.state


def use_lock(env: Any) -> Spot:
    """What a thread holds while it asks the environment something."""
    return session(env).use, "lock"


def clean_up(env: Any) -> None:
    """What a thread does that has outlasted a ``close``."""
    with session(env).use.hold("a test"):
        return


def live_by(env: Any, lifecycle: Lifecycle) -> None:
    found = session(env)
    for owner in (found, found.lease, found.prewarm, found.requests):
        owner.lifecycle = lifecycle


def manifest(env: Any) -> EnvManifest:
    return session(env).manifest


def bounds(env: Any) -> list[tuple[int, int]]:
    """The slices of its sub-environments, one for each shard."""
    return session(env).bounds


def repository(env: Any) -> Repository:
    """The repository that it comes from, with its policy and its servers."""
    return session(env).repository


@contextlib.contextmanager
def hurried(env: Any, **timeouts: float) -> Iterator[None]:
    """What is asked of it meanwhile has these ``Timeouts``; it was made, and goes on, without."""
    found, before = repository(env), repository(env).timeouts
    env._timeouts = env._requests._timeouts = found.timeouts = replace(before, **timeouts)
    try:
        yield
    finally:
        env._timeouts = env._requests._timeouts = found.timeouts = before


def launcher(env: Any) -> Launcher:
    return session(env).lease._launcher


@contextlib.contextmanager
def hurried_part(env: Any, worker: int, **timeouts: float) -> Iterator[None]:
    """``hurried``, for what one of its workers is sent; the others may be as slow as ever."""
    part, queue = parts(env)[worker], env._in_flight()._queues[worker]
    before = part.repository.timeouts
    owners = part.requests, queue
    try:
        for owner in owners:
            owner._timeouts = replace(before, **timeouts)
        yield
    finally:
        for owner in owners:
            owner._timeouts = before


def part_pids(part: EnvSession) -> list[int]:
    """The processes of one worker's jail; asked over a connection of its own."""
    at = part.lease._at()
    return list(part.lease._launcher.status(*at, 60.0)["pids"])


def asks_patiently(env: Any) -> None:
    """Its server has a minute to say what a late worker does: a loaded one needs more than one
    second at times, and the error then says nothing of it."""
    found: Any = launcher(env)
    found.status = partial(found.status, timeout_s=60.0)


def written_later(lane: Any, word: int, value: int) -> Callable[[], bool]:
    """``lane.answered`` of a lane in shared memory whose jail writes one word into each reply as
    soon as that has said yes."""
    answered = lane.answered

    def and_changed() -> bool:
        said: bool = answered()
        if said:
            for shard in lane.shards:
                shard._tells[word] = value
        return said

    return and_changed


def use_lock_of(part: EnvSession) -> Any:
    """What a thread holds while it asks one worker something."""
    return part.use.lock


def recipe(suites: Any) -> Recipe | None:
    """What a pickle of these suites holds."""
    return suites._recipe


# --- where it lives ----------------------------------------------------------------------------


def loaded(env: Any) -> LoadedJail | None:
    """The jail that it has, and the server of that; None while it runs nowhere."""
    return session(env).lease.loaded


def jail(env: Any) -> JailHandle:
    return _running(env).jail


def client(env: Any) -> WorkerConnection:
    return jail(env).client


def server(env: Any) -> Any:
    """Its worker server: an endpoint, and a process where that is ours."""
    return _running(env).server


def users(env: Any) -> int:
    return _running(env).use.users()


def pids(env: Any) -> list[int]:
    """The processes of its jail, as its server knows them."""
    status, _ = client(env).request(m.GetStatus(), deadline=Deadline(60))
    jails = [one for one in status.jails if isinstance(one, dict)]
    return next(list(one["pids"]) for one in jails if one["jail"] == jail(env).number)


def jails(env: Any) -> int:
    status, _ = client(env).request(m.GetStatus(), deadline=Deadline(60))
    return len(status.jails)


def request_words(lane: LaneShard) -> Any:
    """What a shard's runner reads before it does anything."""
    return lane._asks


def lane(env: Any) -> SharedMemoryLane | None:
    found = session(env).lease.lane
    return found if isinstance(found, SharedMemoryLane) else None


def wait_awake(env: Any, budget_ns: int) -> None:
    """Have its steps be waited for awake for so long, on the core that we are on now."""
    shared: Any = lane(env)
    shared._step_spin.budget_ns = budget_ns
    shared._cores.look_again()


def release_of_server(env: Any) -> Callable[[], None]:
    """What lets go of the server that it holds while it has no jail."""
    return session(env).lease._release_server


def hold_server(env: Any, release: Callable[[], None]) -> None:
    """Have it hold its server, and call this to let go of it."""
    session(env).lease._release_server = release


def _running(env: Any) -> LoadedJail:
    found = loaded(env)
    assert found is not None, f"the environment has no jail: {state(env).name}"
    return found


HARMLESS_DENIALS = denials._HARMLESS
"""What a recorded jail is denied that is no attempt of the repository's."""
PATIENCE_FOR_AN_END: Spot = (task, "_EPISODE_S")
"""Seconds in which the judge looks for the end of an episode."""
FETCHING_THE_REST_S: Spot = (output, "_ASK_S")
"""How long a server may go on answering who wants a jail's last output."""
wrong_types = task._untyped
wrong_masks = traces._masks
info_bytes = traces._bytes_of
small_trace = partial(traces.Trace, _left=1 << 20)


def keep_few_findings(monkeypatch: pytest.MonkeyPatch) -> None:
    """A survey that keeps 1,000 findings, and reads 2 MiB of texts."""
    monkeypatch.setattr(static, "_MOST", 1_000)
    monkeypatch.setattr(static, "_MOST_BYTES_IN_ALL", 2 << 20)


# --- the connection to another host ------------------------------------------------------------


def link(env: Any) -> Any:
    """The link to a server elsewhere, as its client sees it."""
    return client(env)._link


def link_is_up(found: Any) -> bool:
    return bool(found._up)


def can_send(found: Any) -> bool:
    """Whether the socket of a link takes a message."""
    return bool(found._socket.poll(0, zmq.POLLOUT))


def link_losses(found: Any) -> int:
    return int(found._lost)


def fall_silent(env: Any) -> None:
    """End the thread that tells the server that this client lives."""
    server(env)._stop.set()


def send_half(connection: WorkerConnection, frames: Sequence[Buffer]) -> None:
    """The first frame of a message, and no more."""
    connection._socket.send(frames[0], zmq.SNDMORE)


# --- spots -------------------------------------------------------------------------------------

LATE_REPLY_GRACE: Spot = (env_session, "GRACE_S")
"""For how long ``reset`` waits for a late reply."""
SHARE_OF_A_SERVER: Spot = (launcher_module, "_SHARE")
"""How much of the time for a start one server of a fleet may use."""
CLOSE_PATIENCE: Spot = (env_session, "INTERRUPT_S")
"""For how long ``close`` waits for another thread."""
WAITS_FOR_A_SERVER: tuple[Spot, Spot] = ((launcher_module, "_CLOSE_S"), (remote, "_CLOSE_S"))
"""For how long a close waits for a server's word, also where it has gone."""
CONTEXTS: Spot = (connection, "_contexts")
"""ZeroMQ's contexts, by process."""
WAIT_FOR_OUTPUT: Spot = (output, "_ASK_S")
"""How long a server may take to say what a jail has printed; who follows it then gives up."""
STATUS_WAIT_MS: Spot = (status_command, "_WAIT_MS")
"""For how long ``envhub-worker status`` waits for its server."""
MAKER: Spot = (make_env, "EnvFactory")
"""What ``make_env`` starts to work with when its arguments have been checked."""
CONTAINER_MARKS: Spot = (listen_options, "_CONTAINER_MARKS")
"""The files by which a container is told."""
CGROUP_WRITE: Spot = (cgroups, "_write")
"""What writes a file of a control group."""
DECODING: Spot = (message, "_checked")
"""What makes a message of a decoded document that has no form yet."""
CHOICE_OF_RUNTIME: Spot = (make_env, "Runtime")
CHOICE_OF_PACKAGES: Spot = (source, "packages_for")
CUT_S: Spot = (tcp, "_CUT_S")
"""For how long a server may end handshakes."""
FIRST_KEEP_ALIVE_S: Spot = (remote, "_FIRST_S")
"""After how long a server on another host first hears that its client lives."""
IMPORTS_IN_MEMORY: Spot = (modules, "_READ")
"""What was read of repositories in this process."""
FINDING_INTERPRETERS: Spot = (interpreters, "_others")
TELLING_RELEASES_APART: Spot = (resolutions, "_stamp")
"""Says which release lies at an interpreter's path."""
MAY_SPIN: Spot = (served_slabs, "_MAY_SPIN")
"""Whether a server and a runner wait awake for one another on this machine."""
FORMS: Spot = message, "_INCOMING"
"""What is kept of messages that were received."""
CHECK_OF_WARNINGS: Spot = (prefix.WARNINGS, "_check")
"""What looks at each warning of a worker's."""
CONTAINERS: Spot = (container, "_POOL")
"""The containers of this process."""
CONTAINER_STARTS: Spot = (container.RepositoryContainer, "_start")
"""What starts one."""


def ending(env: Any) -> Spot:
    return session(env).lease._jails, "end"


def holding(env: Any) -> Spot:
    """Where it takes hold of its server, while it has no jail."""
    return launcher(env), "hold"


def sending(connection: WorkerConnection) -> Spot:
    """Where the frames of a message go out."""
    return connection, "_put"


# --- one module at a time ----------------------------------------------------------------------


def forms() -> dict[Any, Any]:
    """What is kept of received messages now."""
    return message._INCOMING._forms


def living(ledger: Ledger) -> Any:
    """The environments that a ledger still knows."""
    return ledger._living


def monitor_script() -> Path:
    """The script that ends a container after its client."""
    return container._MONITOR


def is_own_group(path: Path) -> bool:
    return folders._is_own_group(str(path), os.stat(path))


def zygote_pid(spawner: Spawner) -> int:
    return spawner._process.pid


def runtime_folder(spawner: Spawner) -> Path:
    """Where a spawner keeps its own files."""
    return spawner._folder


#: Says whether an attempt of a runner's test of itself was denied, and takes what it found.
DENIED: Spot = (stages_runner, "_denied")
HOLD: Spot = (stages_runner, "_hold")


def self_test(jail: Any, descriptors: Iterable[int]) -> None:
    """What a runner tries at the end of its confinement."""
    stages_runner._self_test(jail, descriptors)


def step_aside(group: str) -> None:
    cgroups._step_aside(group)


def gate_of(options: Any, folder: Path, identity: Identity) -> Any:
    """The gate that ``envhub-worker listen`` puts before a server."""
    return listen._gate(options, folder, identity, Log(), None)


def public_key(gate: RemoteGate) -> bytes:
    keys = gate._rules.keys
    return keys.public


def happen(doorman: ConnectionLimiter, event: int, value: int = 0) -> None:
    """Tell a doorman what libzmq's monitor would."""
    doorman._happened(event, value)


def door_is_shut(doorman: ConnectionLimiter) -> bool:
    return doorman._shut_listener is not None


# --- a repository's packages -------------------------------------------------------------------


def making_an_environment(step: str) -> Spot:
    """A step of it: ``install``, ``size``, ``compile``, ``close`` or ``publish``."""
    return environments, f"_{step}"


def flight_of(env: Any) -> Any:
    """The lock that a reset holds, and a recv."""
    return env._requests.use.flight
