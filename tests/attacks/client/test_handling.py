"""Whatever the handling of a worker's input raises: one error of ours, and one jail given up.
What is injected here stands for what nobody has thought of. The control is the same code without
what stands around it: there the injected error comes out as it is."""

import signal
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from envhub_sandbox.errors import (
    EnvHubError,
    MessageTooLargeError,
    RemoteProtocolError,
    WorkerDiedError,
)
from envhub_sandbox.transport import results
from envhub_worker.protocol import errors
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest.manifest import Manifest, encode_env, encode_manifest
from envhub_worker.protocol.spaces import batches
from tests.attacks.client.lies import ACTIONS, opened, relayed, started
from tests.attacks.client.lying_server import (
    NUM_ENVS,
    Asked,
    Frames,
    LyingServer,
    env_manifest,
    lying,
    step_done,
)
from tests.support import inside
from tests.support.repositories import write_repository

ERRORS = [
    AttributeError("a"),
    BlockingIOError(11, "full"),
    IndexError("i"),
    KeyError("\x1b[2J" * 1000),
    MemoryError(),
    OverflowError("o"),
    RecursionError("r"),
    RuntimeWarning("w"),
    StopIteration(),
    struct.error("s"),
    TypeError("unhashable"),
    UnicodeDecodeError("utf-8", b"\xff", 0, 1, "u"),
    ValueError("v"),
]


RESET_ERRORS = [KeyError("k"), MemoryError()]


@pytest.fixture
def other(tmp_path: Path) -> Iterator[Any]:
    repository = str(write_repository(tmp_path / "other", f"# other {tmp_path}"))
    with lying() as honest, started(honest, repository) as env:
        yield env


def raising(error: BaseException) -> Callable[..., Any]:
    def fail(*_: object) -> Any:
        raise error

    return fail


def raising_here(error: BaseException, otherwise: Callable[..., Any]) -> Callable[..., Any]:
    """The same in this thread only: the liar has another."""
    here = threading.get_ident()

    def fail(*arguments: Any) -> Any:
        if threading.get_ident() == here:
            raise error
        return otherwise(*arguments)

    return fail


def test_what_handling_raises_is_the_workers_fault(
    liar: LyingServer, folder: str, other: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is told as such, printable and with the place; that jail ends, the others go on."""
    policy = {"restart": "on_reset", "restart_backoff_s": 0, "restart_budget": len(ERRORS) + 2}
    with started(liar, folder, policy=policy) as env:
        for error in (*ERRORS, *RESET_ERRORS):
            ask = env.reset if error in RESET_ERRORS else lambda: env.step(ACTIONS)
            closed = sum(isinstance(asked, m.CloseJail) for asked in liar.asked)
            with monkeypatch.context() as patched:
                patched.setattr(results.batches, "conforms", raising(error))
                with pytest.raises(RemoteProtocolError) as caught:
                    ask()
            assert caught.value.__cause__ is error
            assert isinstance(caught.value, MessageTooLargeError) == isinstance(error, MemoryError)
            assert str(caught.value).isprintable()
            assert sum(isinstance(asked, m.CloseJail) for asked in liar.asked) > closed, error
            with pytest.raises(WorkerDiedError):
                env.step(ACTIONS)
            other.step(ACTIONS)
            env.reset()
            env.step(ACTIONS)


@pytest.mark.parametrize("error", [KeyError("k"), MemoryError(), StopIteration()], ids=repr)
def test_what_decoding_raises_is_the_workers_fault(
    liar: LyingServer, folder: str, other: Any, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    with started(liar, folder, policy={"restart": "on_reset"}) as env:
        with monkeypatch.context() as patched:
            patched.setattr(*inside.DECODING, raising_here(error, getattr(*inside.DECODING)))
            liar.lies[m.Step] = relayed(m.Value({"never": "seen"}))
            with pytest.raises(RemoteProtocolError) as caught:
                env.step(ACTIONS)
        assert error in (caught.value.__cause__, getattr(caught.value.__cause__, "__cause__", None))
        other.step(ACTIONS)
        liar.lies.clear()
        env.reset()
        env.step(ACTIONS)


def test_without_the_mechanism_it_comes_out(
    liar: LyingServer, folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The control: what stands around the handling is what turns it."""
    monkeypatch.setattr(errors, "FAULTS", ())
    with started(liar, folder) as env, monkeypatch.context() as patched:
        patched.setattr(results.batches, "conforms", raising(TypeError("unhashable")))
        with pytest.raises(TypeError, match="unhashable"):
            env.step(ACTIONS)


class _AlarmError(Exception):
    """Raised by the caller's own handler."""


@pytest.mark.parametrize("error", [KeyboardInterrupt(), _AlarmError()], ids=["Ctrl-C", "own"])
def test_what_is_the_callers_own_passes(
    liar: LyingServer, folder: str, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    """An interrupt in the midst of the handling is nobody's fault, and nothing is given up."""
    with started(liar, folder) as env:
        with monkeypatch.context() as patched:
            patched.setattr(results.batches, "conforms", raising(error))
            with pytest.raises(type(error)):
                env.step(ACTIONS)
        env.step(ACTIONS)


def test_what_a_signal_handler_raises_in_a_wait_passes(liar: LyingServer, folder: str) -> None:
    """Even where it is of a class that handling might raise: nobody had anything to handle."""
    caller = threading.get_ident()

    def lie(_: Asked) -> list[Frames]:
        threading.Timer(0.3, signal.pthread_kill, (caller, signal.SIGALRM)).start()
        return []

    def ring(*_: object) -> None:
        raise ValueError("the caller's own")

    liar.lies[m.Step] = lie
    before = signal.signal(signal.SIGALRM, ring)
    try:
        with started(liar, folder) as env:
            with pytest.raises(ValueError, match="own") as caught:
                env.step(ACTIONS)
            assert not isinstance(caught.value, EnvHubError)
            liar.lies.clear()
            env.reset()
            env.step(ACTIONS)
    finally:
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("key", [(1, 2), frozenset({1, 2}), range(3)], ids=repr)
def test_keys_of_no_text_harm_none(liar: LyingServer, folder: str, other: Any, key: object) -> None:
    """Infos with such a key come the third time as the first, and others step in between."""
    liar.lies[m.Step] = relayed(step_done(info={"visits": {key: 1}}))
    with started(liar, folder) as env:
        for _ in range(4):
            assert env.step(ACTIONS)[4] == {"visits": {key: 1}}
            other.step(ACTIONS)


GRAPHS = spaces.Dict({"g": spaces.Graph(spaces.Box(0, 1, (2,)), None), "x": spaces.Discrete(2)})
ODD: dict[str, Any] = {
    "nothing": None,
    "a number": 5,
    "a text": "ab",
    "a mapping": {"g": 1},
    "numbers": np.zeros(NUM_ENVS),
    "a tuple": (1, 2),
    "another mapping": {"g": (1, 2), "x": 3},
    "objects": np.array([{"g": (1, 2, 3)}, 4], object),
    "a square of objects": np.full((2, 2), None, object),
}


@pytest.mark.parametrize("shardable", [False, True])
@pytest.mark.parametrize("place", ["observation", "final_obs"])
def test_odd_graph_observations(
    liar: LyingServer, folder: str, shardable: bool, place: str
) -> None:
    """Where members get their class back, any value is taken as it is, or refused."""
    described = env_manifest(
        shardable=shardable,
        single_observation_space=GRAPHS,
        observation_space=batch_space(GRAPHS, NUM_ENVS),
    )
    liar.lies[m.Load] = relayed(m.LoadDone(encode_manifest(Manifest(envs=(described,), lazy=True))))
    liar.lies[m.Build] = relayed(m.BuildDone(encode_env(described)))
    graph = (np.zeros((1, 2), np.float32), None, None)
    good = {"g": (graph,) * NUM_ENVS, "x": np.zeros(NUM_ENVS, np.int64)}
    liar.lies[m.Reset] = relayed(m.ResetDone(good, {}))
    policy = {"restart": "on_reset", "restart_backoff_s": 0, "restart_budget": len(ODD)}
    with opened(liar, folder, policy=policy) as suites:
        for odd in ODD.values():
            done = {"observation": good, "info": {"final_obs": odd}}
            if place == "observation":
                done = {"observation": odd}
            liar.lies[m.Step] = relayed(step_done(**done))
            observation, _ = suites.env.reset()
            assert type(observation["g"][0]).__name__ == "GraphInstance"
            if shardable and place == "observation":
                with pytest.raises(RemoteProtocolError):
                    suites.env.step(ACTIONS)
            else:
                for _ in range(3):
                    suites.env.step(ACTIONS)


def test_columns_have_a_value_each_and_masks_of_our_own() -> None:
    def column(values: Any, mask: Any) -> dict[Any, Any]:
        return {batches.APART_CLASSES: {"a": False}, "a": values, "_a": mask}

    honest = column(np.full(1, 3.0), np.ones(1, bool))
    joins = results.Results(env_manifest(), [(0, 1), (1, NUM_ENVS)])
    assert joins.infos([honest, honest])["a"].tolist() == [3, 3]  # the control
    for lie in (np.ones(3, bool), np.zeros((1, 1), bool), [True, True], None):
        assert joins.infos([honest, column(np.zeros(1), lie)])["_a"].tobytes() == b"\1\1"
        with pytest.raises(RemoteProtocolError):
            joins.infos([honest, column(lie, honest["_a"])])
