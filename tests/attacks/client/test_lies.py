"""A hostile worker against the client: whatever it answers, the client stays whole.
A lie ends in one of this project's errors, executes nothing, and costs bounded memory and time;
afterwards the client closes the environment and works on with others."""

import contextlib
import os
import pickle
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox import make_env
from envhub_sandbox.errors import (
    ActionError,
    EnvHubError,
    RemoteProtocolError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.vector.actions import UniterableError
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.limits import MAX_NUM_ENVS
from envhub_worker.protocol.manifest.manifest import decode_manifest, encode_env
from envhub_worker.protocol.spaces.spaces import encode_space
from tests.attacks.client.lies import (
    ACTIONS,
    MIB,
    Canary,
    opened,
    peak_growth,
    pickled,
    refuses,
    relayed,
    started,
)
from tests.attacks.client.lying_server import (
    NUM_ENVS,
    Asked,
    Frames,
    LyingServer,
    env_manifest,
    manifest,
    step_done,
)
from tests.attacks.output.painting import ESCAPES, paints
from tests.support import inside
from tests.support.repositories import CARTPOLES, write_repository
from tests.support.wire import decode_space, deep, ext, packed, value

PLACES: dict[str, Callable[[Any], m.Message]] = {
    "observation": lambda evil: step_done(observation=evil),
    "in an observation": lambda evil: step_done(observation={"a": (evil,)}),
    "rewards": lambda evil: step_done(rewards=evil),
    "in rewards": lambda evil: step_done(rewards=np.array([evil, 0.0], object)),
    "terminations": lambda evil: step_done(terminations=evil),
    "truncations": lambda evil: step_done(truncations=evil),
    "info": lambda evil: step_done(info={"a": evil}),
    "an array of an info": lambda evil: step_done(info={"a": np.array([evil, None], object)}),
    "a set of an info": lambda evil: step_done(info={"a": {1, evil}}),
    "a slice of an info": lambda evil: step_done(info={"a": slice(evil, None)}),
    "a key of an info": lambda evil: step_done(info={(evil,): 1}),
}


def values(evil: Any) -> m.Message:
    return m.Value((evil,) * NUM_ENVS)


REPLIES: dict[str, tuple[type[m.Message], Callable[[Any], m.Message], Callable[[Any], object]]] = {
    **{what: (m.Step, make, lambda env: env.step(ACTIONS)) for what, make in PLACES.items()},
    "reset": (m.Reset, lambda evil: m.ResetDone(evil, {}), lambda env: env.reset()),
    "call": (m.Call, values, lambda env: env.call("x")),
    "render": (m.Render, values, lambda env: env.render()),
    "get_attr": (m.Call, values, lambda env: env.get_attr("x")),
    "np_random": (m.GetRandom, values, lambda env: env.np_random),
}


@pytest.mark.short
@pytest.mark.parametrize("what", REPLIES)
def test_pickles_in_replies_are_never_loaded(
    liar: LyingServer, folder: str, tmp_path: Path, what: str
) -> None:
    """Wherever a reply can hold a value, a pickle there is refused, and not loaded."""
    canary = tmp_path / "executed"
    kind, make, act = REPLIES[what]
    with started(liar, folder) as env:
        liar.lies[kind] = relayed(pickled(make(Canary(canary))))
        error = refuses(lambda: act(env))
    assert isinstance(error, RemoteProtocolError)
    assert not canary.exists()


@pytest.mark.parametrize("name", ["metadata", "spec", "task", "suite", "attributes", "render_mode"])
def test_pickles_in_manifests_are_never_loaded(
    liar: LyingServer, folder: str, tmp_path: Path, name: str
) -> None:
    canary = tmp_path / "executed"
    described = manifest()
    evil: Any = Canary(canary)
    described["envs"][0][name] = {"a": evil} if name in ("metadata", "spec") else evil
    liar.lies[m.Load] = relayed(pickled(m.LoadDone(described)))
    refuses(lambda: opened(liar, folder))
    assert not canary.exists()


@pytest.mark.short
def test_pickle_for_a_reply_is_never_loaded(liar: LyingServer, folder: str, tmp_path: Path) -> None:
    """Nor is one that comes instead of a message, as frames of older protocols did. The control:
    loading it executes it."""
    canary = tmp_path / "executed"
    data = cloudpickle.dumps(Canary(canary))
    liar.lies[m.Step] = lambda asked: [[data]]
    liar.lies[m.Reset] = relayed([data])
    with opened(liar, folder) as suites:
        refuses(suites.env.reset)
        refuses(lambda: suites.env.step(ACTIONS))
    assert not canary.exists()
    pickle.loads(data)
    assert canary.exists()


WRONG: dict[str, dict[str, Any]] = {
    "observation of another shape": {"observation": np.zeros((NUM_ENVS, 4), np.float32)},
    "observation of too many": {"observation": np.zeros((NUM_ENVS + 1, 3), np.float32)},
    "observation of none": {"observation": np.zeros((0, 3), np.float32)},
    "observation of another dtype": {"observation": np.zeros((NUM_ENVS, 3), np.float64)},
    "observation of objects": {"observation": np.zeros((NUM_ENVS, 3), object)},
    "observation of text": {"observation": np.zeros((NUM_ENVS, 3), "U4")},
    "observation is a list": {"observation": [[0.0] * 3] * NUM_ENVS},
    "observation is None": {"observation": None},
    "observation is a dict": {"observation": {"a": np.zeros((NUM_ENVS, 3), np.float32)}},
    "rewards of another length": {"rewards": np.zeros(NUM_ENVS + 1)},
    "rewards of no dimension": {"rewards": np.float64(0)},
    "rewards of objects": {"rewards": np.array([{}, []], object)},
    "rewards of text": {"rewards": np.array(["a", "b"])},
    "rewards of two dimensions": {"rewards": np.zeros((NUM_ENVS, 2))},
    "rewards is a list": {"rewards": [0.0] * NUM_ENVS},
    "terminations of objects": {"terminations": np.array([None, {}], object)},
    "terminations of numbers": {"terminations": np.array([0.5, 2.0])},
    "terminations of two dimensions": {"terminations": np.zeros((NUM_ENVS, 2), bool)},
    "truncations of text": {"truncations": np.array(["a", "b"])},
    "truncations is None": {"truncations": None},
}


@pytest.mark.short
@pytest.mark.parametrize("what", list(WRONG))
def test_wrong_arrays_are_refused(liar: LyingServer, folder: str, what: str) -> None:
    liar.lies[m.Step] = relayed(step_done(**WRONG[what]))
    with started(liar, folder) as env:
        error = refuses(lambda: env.step(ACTIONS))
    assert isinstance(error, RemoteProtocolError)


def described(value: object) -> Frames:
    return m.pack(m.LoadDone(value))


def changed(**fields: Any) -> dict[str, Any]:
    value = manifest()
    value["envs"][0].update(fields)
    return value


def observed(space: object) -> dict[str, Any]:
    return changed(single_observation_space=space)


def text(longest: int) -> dict[str, Any]:
    return {"kind": "text", "min_length": 0, "max_length": longest, "characters": "ab"}


def box(**fields: Any) -> dict[str, Any]:
    return {**encode_space(spaces.Box(-1, 1, (3,), np.float32)), **fields}


WIDE, ELEMENTS = 4_000_000, 10_000_000


def wide(number: int) -> dict[str, Any]:
    """A Box of 40 megabytes in the client, unlike any other; a few hundred bytes say so."""
    return box(shape=(WIDE,), low=np.array(-number, np.float32))


def many() -> dict[str, Any]:
    """A task whose sub-environments take 16 megabytes in the client before one has started."""
    return changed(num_envs=MAX_NUM_ENVS, sync=False, independent=False)


def test_a_task_of_many_sub_environments_is_accepted() -> None:
    """The control: one of those that are too many together."""
    assert decode_manifest(many(), max_elements=ELEMENTS).envs[0].num_envs == MAX_NUM_ENVS


# some: test_manifest and test_spaces have all that a description may be
MANIFESTS: dict[str, Callable[[], dict[str, Any]]] = {
    "absurdly many sub-environments": lambda: changed(num_envs=2**40),
    "a name with an escape sequence": lambda: changed(task="\x1b[2J"),
    "an absurd Box": lambda: observed(box(shape=(2**40, 2**20))),
    "a Box just over the limit": lambda: changed(observation_space=box(shape=(200_000_001,))),
    "an absurd Text": lambda: observed(text(2**62)),
    "a Text that nobody could draw": lambda: observed(text(200_000_000)),
    "a hundred Boxes that would each pass": lambda: {
        **manifest(),
        "envs": tuple({**observed(wide(n))["envs"][0], "task": n} for n in range(100)),
    },
    "a hundred tasks of sub-environments that would each pass": lambda: {
        **manifest(),
        "envs": tuple({**many()["envs"][0], "task": n} for n in range(100)),
    },
    "a Box of Boxes that would each pass": lambda: changed(
        observation_space={"kind": "tuple", "spaces": [wide(n) for n in range(100)]}
    ),
    "an unknown kind of space": lambda: observed({"kind": "os.system"}),
}


@pytest.mark.parametrize("what", list(MANIFESTS))
def test_lying_manifests_are_refused(liar: LyingServer, folder: str, what: str) -> None:
    """A description that cannot be true, or is absurdly large, is refused before it is built. The
    control: one of those that are too many together."""
    assert decode_space(wide(1), max_elements=ELEMENTS).shape == (WIDE,)
    liar.lies[m.Load] = relayed(described(MANIFESTS[what]()))
    limits = {"elements": ELEMENTS}
    refuses(lambda: opened(liar, folder, policy={"limits": limits}))


OTHERS: dict[str, tuple[type[m.Message], m.Message]] = {
    "no such task": (m.LoadTask, m.Value(None)),
    "another number": (m.LoadTask, m.Value((NUM_ENVS + 1, True))),
    "a vector environment of its own": (m.LoadTask, m.Value((NUM_ENVS, False))),
    "arrays": (m.LoadTask, m.Value((np.arange(3), np.arange(3)))),
    "an array": (m.LoadTask, m.Value(np.arange(2))),
    "a manifest": (m.LoadTask, m.LoadDone(manifest())),
    "fewer built": (m.Build, m.BuildDone(encode_env(env_manifest(num_envs=1)))),
    "another mode": (m.Build, m.BuildDone(encode_env(env_manifest(autoreset_mode="Disabled")))),
    "nothing built": (m.Build, m.BuildDone({})),
    "a value built": (m.Build, m.Value(None)),
}


@pytest.mark.parametrize("what", list(OTHERS))
def test_another_environment_is_refused(liar: LyingServer, folder: str, what: str) -> None:
    """Whichever way it shows that what a jail holds is not what the manifest says. The control:
    the honest answers."""
    opened(liar, folder).close()
    with started(liar, folder):
        pass
    asked, answer = OTHERS[what]
    liar.lies[asked] = relayed(answer)
    with opened(liar, folder) as suites:
        refuses(suites.env.reset)


DISAGREEING: dict[str, dict[str, Any]] = {
    "batched space of another number": {"num_envs": 3},
    "batched space of another kind": {"observation_space": encode_space(spaces.Discrete(5))},
    "action space of another number": {"action_space": encode_space(spaces.MultiDiscrete([2] * 7))},
    "its own action space, and slabs for the single one": {
        "shardable": False,
        "action_space": encode_space(spaces.MultiDiscrete([2] * 7)),
    },
    "its own mapping of actions": {
        "shardable": False,
        "action_space": encode_space(spaces.Dict(a=spaces.Discrete(3))),
    },
}


@pytest.mark.parametrize("what", list(DISAGREEING))
def test_contradictory_manifest_does_no_harm(liar: LyingServer, folder: str, what: str) -> None:
    """Single and batched spaces that do not belong together: an error, or what one has."""
    liar.lies[m.Load] = relayed(described(changed(**DISAGREEING[what])))
    with contextlib.suppress(EnvHubError), opened(liar, folder) as suites:
        observation, _ = suites.env.reset()
        # what was declared for one sub-environment decides; the rest is for the caller to read
        assert observation.shape == (suites.env.num_envs, 3)
        assert len(suites.env.step(suites.env.action_space.sample())) == 5


def test_spaces_and_errors_about_them_do_not_paint(liar: LyingServer, folder: str) -> None:
    """Gymnasium prints the characters of a Text as they are, which is the control."""
    single = spaces.Text(9, charset=ESCAPES)
    assert paints(str(single))
    text, batch = encode_space(single), encode_space(spaces.Tuple([single] * NUM_ENVS))
    ours = {"single_action_space": text, "action_space": batch}
    seen = {"single_observation_space": text, "observation_space": batch}
    worker = changed(**ours, **seen)
    liar.lies[m.Load] = relayed(described(worker))
    liar.lies[m.Build] = relayed(m.BuildDone(worker["envs"][0]))
    with opened(liar, folder) as suites:
        env = suites.env
        errors = [
            refuses(env.reset),
            refuses(lambda: env.step(3)),
            refuses(lambda: env.step(["x"])),
        ]
        shown = [env.single_action_space, env.action_space, env.single_observation_space]
        assert env.single_action_space == single
        assert not any(map(paints, map(str, shown)))
    assert [type(error) for error in errors] == [RemoteProtocolError, UniterableError, ActionError]
    assert not any(paints(str(error)) for error in errors)


# some: test_codec_hostile and the decoder's bombs have all that a document may be
DOCUMENTS: dict[str, Callable[[], Frames]] = {
    "nothing": lambda: [b""],
    "noise": lambda: [os.urandom(4096)],
    "no message": lambda: packed("hello"),
    "an unknown kind": lambda: packed([9999, 1]),
    "a kind that is a list": lambda: packed([[], 1]),
    "too few fields": lambda: packed([m.StepDone.kind]),
    "too many fields": lambda: packed([m.StepDone.kind, *range(50)]),
    "nested a thousand deep": lambda: packed([m.Value.kind, deep(400)]),
    "nested a million deep": lambda: value(b"\x91" * 1_000_000 + b"\xc0"),
    "a million empty maps": lambda: value(b"\xdd" + struct.pack(">I", 4 * MIB) + b"\x80" * 4 * MIB),
    "an array that claims four billion": lambda: value(b"\xdd\xff\xff\xff\xff"),
    "an array of objects by hand": lambda: packed([m.Value.kind, ext(1, b"|O8")]),
    "an array that is not there": lambda: packed([m.Value.kind, ext(1, b"\x0b\x01" + b"\xff")]),
    "frames that nobody mentioned": lambda: [*m.pack(m.Value(None)), b"x" * 4096],
    "a thousand frames": lambda: [*m.pack(m.Value(None)), *[b"x"] * 5000],
    "a number of a megabyte": lambda: packed([m.Value.kind, ext(3, b"\x7f" * MIB)]),
    "a text of ten megabytes": lambda: packed([m.Value.kind, "x" * (10 * MIB)]),
}


@pytest.mark.short
@pytest.mark.parametrize("what", list(DOCUMENTS))
def test_malformed_answers_are_refused(liar: LyingServer, folder: str, what: str) -> None:
    """Whatever stands where the runner's answer belongs, decoding it is bounded and harmless."""
    frames = DOCUMENTS[what]()
    liar.lies[m.Reset] = relayed(frames)
    with opened(liar, folder) as suites:
        error = refuses(suites.env.reset)
    assert isinstance(error, RemoteProtocolError)


@pytest.mark.parametrize(
    "what", ["nothing", "noise", "no message", "a thousand frames", "nested a million deep"]
)
def test_malformed_server_answers_are_refused(liar: LyingServer, folder: str, what: str) -> None:
    """The same where the server's own message belongs; some of them only make the client wait."""
    frames = DOCUMENTS[what]()
    liar.lies[m.Reset] = lambda asked: [frames]
    timeouts = {"startup_s": 60.0, "reset_s": 1.0, "close_s": 1.0}
    with opened(liar, folder, timeouts=timeouts) as suites:
        refuses(suites.env.reset)


@pytest.mark.parametrize(
    "reply",
    [
        m.Done(),
        m.Welcome(1, "x", 1),
        m.Method(),
        m.Value(None),
        m.LoadDone({}),
        m.Step(1, None),
        m.Hello(m.VERSION, b""),
        m.Death(1, "exit", 0, None, "", "", ""),
        m.Refusal("SandboxUnavailableError", "x", "y", "z"),
        m.JailOpened(1, (), ()),
    ],
    ids=lambda reply: type(reply).__name__,
)
def test_answers_of_other_kinds_are_refused(
    liar: LyingServer, folder: str, reply: m.Message
) -> None:
    liar.lies[m.Step] = relayed(reply)
    with started(liar, folder) as env:
        refuses(lambda: env.step(ACTIONS))


def test_exceptions_choose_no_class(liar: LyingServer, folder: str) -> None:
    before = set(sys.modules)
    names = ("SystemExit", "KeyboardInterrupt", "os.system", "antigravity.Oops", "__import__", "")
    for name in names:
        liar.lies[m.Step] = relayed(m.RaisedException(name, name, "x" * 100, "y", "step"))
        with opened(liar, folder) as suites:
            suites.env.reset()
            refuses(lambda suites=suites: suites.env.step(ACTIONS))
    assert not {module for module in set(sys.modules) - before if module in ("antigravity",)}


@pytest.mark.short
def test_silence_ends_at_the_deadline(liar: LyingServer, folder: str) -> None:
    liar.lies[m.Step] = lambda asked: []
    liar.lies[m.Close] = lambda asked: []
    timeouts = {"startup_s": 60.0, "step_s": 60.0, "reset_s": 60.0, "close_s": 0.3}
    with started(liar, folder, timeouts=timeouts) as env:
        with inside.hurried(env, step_s=0.3):
            error = refuses(lambda: env.step(ACTIONS))
            assert isinstance(error, WorkerTimeoutError)
            assert isinstance(refuses(lambda: env.step(ACTIONS)), WorkerError)
        del liar.lies[m.Step]
        env.reset()
        env.step(ACTIONS)


def test_stale_unasked_and_double_answers_are_dropped(liar: LyingServer, folder: str) -> None:
    evil = step_done(rewards=np.full(NUM_ENVS, 666.0))
    good = step_done(rewards=np.full(NUM_ENVS, 1.0))

    def lie(asked: Asked) -> list[Frames]:
        right = asked.request_id
        stale = [asked.answer(evil, number) for number in (1, right - 1, 2**62, 2**63 - 1)]
        return [*stale, asked.answer(good), asked.answer(evil), *stale]

    liar.lies[m.Step] = lie
    with started(liar, folder) as env:
        for _ in range(20):
            _, rewards, *_ = env.step(ACTIONS)
            if (rewards == 666.0).any():
                pytest.fail("an answer that nobody had asked for became a result")


def test_flood_of_unasked_answers_is_bounded(liar: LyingServer, folder: str) -> None:
    def lie(asked: Asked) -> list[Frames]:
        waste = step_done(info={"waste": np.zeros(MIB // 8)})
        return [*(asked.answer(waste, 2**40 + at) for at in range(300)), asked.answer(asked.honest)]

    liar.lies[m.Step] = lie
    with started(liar, folder) as env:
        grown = peak_growth(lambda: env.step(ACTIONS))
    assert grown < 500 * MIB, grown


@pytest.mark.parametrize(
    "parts", [(), (0,), (-1,), (2,), (1, 1), (2**62,), (1, -1, 1)], ids=lambda parts: str(parts)
)
def test_wrong_sums_of_parts_refused(
    liar: LyingServer, folder: str, parts: tuple[int, ...]
) -> None:
    """Nor more answers than runners were asked, each of which would do."""
    frames = m.pack(step_done()) * len(parts)
    liar.lies[m.Step] = lambda one: [[*m.pack_header(m.RelayDone(parts), one.request_id), *frames]]
    with started(liar, folder) as env:
        assert isinstance(refuses(lambda: env.step(ACTIONS)), RemoteProtocolError)


@pytest.mark.parametrize(
    "reply",
    [
        m.Welcome(99, "x", 1),
        m.Refusal("VersionMismatchError", "\x1b[2J", "", ""),
        m.Refusal("os.system", "\x1b[2J", "", ""),
        m.JailOpened(1, (), ()),
        m.JailOpened(1, ("1",), ()),
        m.JailOpened(1, ([],), ()),
        m.JailOpened(1, (1.0,), ()),
        m.Death(-1, "exit", None, "\x1b[2J", "\x1b[2J", "\x1b[2J", "\x1b[2J"),
        m.Value(None),
    ],
    ids=[
        *("version", "painted-refusal", "unknown-refusal", "no-runners"),
        *("a-text", "a-list", "a-float"),
        *("painted-death", "other"),
    ],
)
@pytest.mark.parametrize("request_kind", [m.Hello, m.OpenJail], ids=lambda kind: kind.__name__)
def test_handshake_lies_are_refused(
    liar: LyingServer, folder: str, request_kind: type[m.Message], reply: m.Message
) -> None:
    liar.lies[request_kind] = lambda asked: [asked.answer(reply)]
    error = refuses(lambda: opened(liar, folder))
    assert "\x1b" not in str(error)


def test_everything_else_works_on(liar: LyingServer, folder: str, tmp_path: Path) -> None:
    text = (
        CARTPOLES + "\ndef make_env(n_envs=1, use_async_envs=False):\n    return cartpoles(n_envs)"
    )
    honest = write_repository(tmp_path / "honest", text)
    with make_env(str(honest), n_envs=NUM_ENVS) as real:
        real.env.reset(seed=0)
        liar.lies[m.Step] = lambda asked: [[b"\xff" * 100]]
        with started(liar, folder) as env:
            refuses(lambda: env.step(ACTIONS))
        real.env.step(ACTIONS)
