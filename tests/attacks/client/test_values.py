"""A hostile worker against what the caller is given: specs, generators, seeds, infos.
Each is used as programs use it. The controls take what the worker sent as it is: there a command
runs, a process crashes, and memory becomes random numbers."""

import copy
import json
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.integrations import gym as maker
from envhub_sandbox.transport.values import generator
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest.manifest import (
    EnvManifest,
    Manifest,
    decode_manifest,
    encode_manifest,
)
from tests.attacks.client.lies import (
    SCRIPT,
    STATES,
    mt19937,
    opened,
    pcg64,
    philox,
    refuses,
    relayed,
    spec_of,
)
from tests.attacks.client.lying_server import NUM_ENVS, LyingServer, env_manifest, manifest


def specified(liar: LyingServer, folder: str, spec: dict[str, Any]) -> Any:
    value = manifest()
    value["envs"][0].update(spec=spec, shardable=False)
    liar.lies[m.Load] = relayed(m.LoadDone(value))
    return opened(liar, folder)


# --- specs ----------------------------------------------------------------------------------


MAKERS: dict[str, Callable[[EnvSpec], object]] = {
    "make": gym.make,
    "make_vec": gym.make_vec,
    "its own make": lambda spec: spec.make(),
    "a copy": lambda spec: gym.make(copy.deepcopy(spec)),
    "a pickle": lambda spec: gym.make(pickle.loads(pickle.dumps(spec))),
    "JSON": lambda spec: gym.make(EnvSpec.from_json(spec.to_json())),
    "a vector by threads": lambda spec: gym.make_vec(spec, 2, vectorization_mode="sync"),
}


@pytest.mark.parametrize("how", list(MAKERS))
def test_specs_make_nothing_here(
    liar: LyingServer, folder: str, tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``gym.make(env.spec)`` runs no entry point that a worker names, but makes it again by
    ``make_env``, of the caller's own reference."""
    canary = tmp_path / "made"
    with specified(liar, folder, spec_of(canary)) as suites:
        spec = suites.env.spec
        assert (spec.id, spec.max_episode_steps) == ("Hub-v0", 7)
        assert not spec.additional_wrappers
        spec.kwargs.pop("sandbox")  # that of the test, which JSON has no form for
        made: list[Any] = []
        monkeypatch.setattr(maker, "make_env", lambda ref, **options: made.append(ref))
        with pytest.raises(Exception):  # noqa: B017,PT011  # what that returns is none
            MAKERS[how](spec)
        assert made == [suites.reference]
    assert not canary.exists()
    naive = EnvSpec(**spec_of(canary))
    with pytest.raises(Exception):  # noqa: B017,PT011  # what it returns is no environment
        MAKERS[how](naive)
    assert canary.exists(), "the control failed: the entry point was not called"


@pytest.mark.parametrize("name", ["antigravity:Trap-v0", "a/b/c:d", "a b"])
def test_spec_names_import_nothing(liar: LyingServer, folder: str, name: str) -> None:
    """``gym.make(env.spec.id)`` imports the module before a colon: the id is ours."""
    with specified(liar, folder, {"id": name, "max_episode_steps": -1}) as suites:
        assert suites.env.spec.id == "Hub-v0"
        assert suites.env.spec.max_episode_steps is None


def test_the_control_imports_what_an_id_names(tmp_path: Path) -> None:
    (tmp_path / "trap.py").write_text("open(__file__ + '.imported', 'w')")
    code = "import gymnasium, sys; sys.path.insert(0, sys.argv[1]); gymnasium.make('trap:A-v0')"
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, check=False)
    assert (tmp_path / "trap.py.imported").exists()


# --- random generators ----------------------------------------------------------------------


def states(*each: Any) -> Any:
    numbered = ({**one, "number": 1} if isinstance(one, dict) else one for one in each)
    return relayed(m.Value(tuple(numbered)))


FIRST = {**philox(), "number": 1}


@pytest.mark.parametrize("what", ["a short key", "a flag of two", "no mapping"])
def test_generator_states_are_checked(liar: LyingServer, folder: str, what: str) -> None:
    """numpy checks none of a state's fields, so the client does; the last tests have them all."""
    with opened(liar, folder) as suites:
        liar.lies[m.GetRandom] = states(pcg64(), STATES[what])
        error = refuses(lambda: suites.env.np_random)
        assert isinstance(error, RemoteProtocolError)
        liar.lies[m.GetRandom] = states(pcg64(), philox())
        assert [type(made.bit_generator) for made in suites.env.np_random] == [
            np.random.PCG64,
            np.random.Philox,
        ]


LATER: dict[str, Any] = {
    "a state that there cannot be": m.Value(({**philox(buffer_pos=-64), "number": 1}, FIRST)),
    "a number that is a flag": m.Value(({**philox(), "number": True}, FIRST)),
    "no number": m.Value((philox(), FIRST)),
    "one for all": m.Value(FIRST),
    "one too many": m.Value((FIRST,) * 3),
}


@pytest.mark.parametrize("what", [None, *LATER])
def test_a_generator_that_the_caller_keeps_gets_no_bad_state(
    liar: LyingServer, folder: str, what: str | None
) -> None:
    """It is brought up to date in place after each request, by states that are checked as before.
    The control is an honest worker, whose state it takes."""
    with opened(liar, folder) as suites:
        liar.lies[m.GetRandom] = relayed(m.Value((FIRST, FIRST)))
        kept = suites.env.np_random
        before = copy.deepcopy(kept[0].bit_generator.state)
        honest = relayed(m.Value(({**philox(has_uint32=1), "number": 1}, FIRST)))
        liar.lies[m.GetRandom] = relayed(LATER[what]) if what else honest
        if what is None:
            suites.env.reset()
            assert suites.env.np_random[0] is kept[0]
            assert kept[0].bit_generator.state["has_uint32"] == 1
        else:
            assert isinstance(refuses(suites.env.reset), RemoteProtocolError)
            assert str(kept[0].bit_generator.state) == str(before)


CRASH = """
import numpy as np
bits = np.random.MT19937()
bits.state = {"bit_generator": "MT19937",
              "state": {"key": np.arange(624, dtype=np.uint32), "pos": 2**31 - 1}}
bits.random_raw()
"""
LEAK = """
import numpy as np
bits = np.random.Philox()
bits.state = {**bits.state, "buffer_pos": -2}
address = bits.random_raw()
maps = [line.split()[0].split("-") for line in open("/proc/self/maps")]
print(any(int(start, 16) <= address < int(end, 16) for start, end in maps))
"""


def test_the_control_crashes_on_an_index_and_draws_memory() -> None:
    crashed, drew = (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        for code in (CRASH, LEAK)
    )
    assert crashed.returncode == -signal.SIGSEGV
    assert drew.stdout.strip() == "True"


@pytest.mark.parametrize("lie", [np.zeros(3), "1", 1.5, {"a": 1}, [1], (None, b"1")], ids=repr)
def test_seeds_are_numbers(liar: LyingServer, folder: str, lie: Any) -> None:
    liar.lies[m.GetOne] = relayed(m.Value(lie))
    with opened(liar, folder) as suites:
        assert isinstance(refuses(lambda: suites.env.np_random_seed), RemoteProtocolError)
        liar.lies[m.GetOne] = relayed(m.Value((3, None)))
        assert suites.env.np_random_seed == (3, None)


# --- names of suites and tasks ---------------------------------------------------------------


def write_videos(folder: Path, names: Iterable[tuple[str, int]]) -> None:
    """As LeRobot's evaluation does, for each task."""
    for suite, task in names:
        (folder / f"{suite}_{task}").mkdir(parents=True, exist_ok=True)


@pytest.mark.parametrize("up", ["absolute", "relative"])
def test_names_of_suites_write_nothing_elsewhere(
    liar: LyingServer, folder: str, tmp_path: Path, up: str
) -> None:
    """A suite named like a path has no caller write outside of the folder of its results."""
    elsewhere = tmp_path / "home"
    suite = str(elsewhere) if up == "absolute" else "../../home"
    value = manifest()
    value["envs"][0]["suite"] = suite
    liar.lies[m.Load] = relayed(m.LoadDone(value))
    assert isinstance(refuses(lambda: opened(liar, folder)), RemoteProtocolError)
    results = tmp_path / "results" / "videos"
    results.mkdir(parents=True)
    write_videos(results, [(suite, 0)])
    assert (tmp_path / "home_0").exists(), "the control failed: nothing was written elsewhere"


def test_odd_infos_are_plain_data(liar: LyingServer, folder: str) -> None:
    odd = {"__class__": 1, "_repr_html_": SCRIPT, b"x": 2, 1.5: 3, ("a", 1): 4, None: 5}
    liar.lies[m.Reset] = relayed(m.ResetDone(np.zeros((NUM_ENVS, 3), np.float32), odd))
    with opened(liar, folder) as suites:
        _, infos = suites.env.reset()
        assert type(infos) is dict
        assert pickle.loads(pickle.dumps(infos)) == copy.deepcopy(infos) == infos
        assert json.loads(json.dumps({"a": infos["_repr_html_"]})) == {"a": SCRIPT}


# --- states of spaces' generators in a manifest; numpy itself takes them ---------------------

ELEMENTS = 100_000


def described(space: Any = None) -> dict[str, Any]:
    space = spaces.Discrete(1000, seed=5) if space is None else space
    env: EnvManifest = env_manifest(single_action_space=space)
    return encode_manifest(Manifest(envs=(env,), lazy=True))


def space_of(value: Any) -> dict[str, Any]:
    return value["envs"][0]["single_action_space"]


def read(value: object, elements: int = ELEMENTS) -> Manifest:
    return decode_manifest(value, max_elements=elements, generator=generator)


def state(**fields: Any) -> dict[str, Any]:
    honest = dict(np.random.PCG64(5).state)
    return {**honest, **fields}


LIES: dict[str, Any] = {
    **{what: [lie] for what, lie in STATES.items() if lie is not None},  # None: there is none
    "no list": {"bit_generator": "PCG64"},
    "too few": [],
    "too many": [None] * 100_000,
    "its own place": [0],
    "a place before it": [-1],
    "a class": [state(bit_generator="Generator")],
    "a field too many": [state(more=1)],
    "a huge integer": [state(state={"state": 1 << 8000, "inc": 1})],
    "an integer of numpy's": [state(uinteger=np.int64(1))],
    "a huge key": [mt19937(key=np.zeros(1 << 20, np.uint32))],
}


def test_the_honest_one_is_taken() -> None:
    found = read(described()).envs[0].single_action_space
    assert [found.sample() for _ in range(5)] == [
        drawn.sample() for drawn in [spaces.Discrete(1000, seed=5)] for _ in range(5)
    ]


@pytest.mark.parametrize("lie", LIES)
def test_a_state_that_there_cannot_be_is_refused(lie: str) -> None:
    value = described()
    assert space_of(value)["generators"]
    space_of(value)["generators"] = LIES[lie]
    with pytest.raises(RemoteProtocolError):
        read(value)


def test_generators_cost_what_spaces_do() -> None:
    """Many small spaces with one each do not fit a budget that they fit without."""
    value = described(spaces.Tuple([spaces.Discrete(2, seed=i) for i in range(100)]))
    bare = described(spaces.Tuple([spaces.Discrete(2, seed=i) for i in range(100)]))
    del space_of(bare)["generators"]
    read(bare, 15_000)
    with pytest.raises(RemoteProtocolError, match="cost more"):
        read(value, 15_000)


def test_one_inside_of_a_space_is_refused() -> None:
    value = described(spaces.Tuple([spaces.Discrete(2, seed=1)]))
    inner = space_of(value)["spaces"][0]
    inner["generators"] = [state()]
    with pytest.raises(RemoteProtocolError, match="wrong attributes"):
        read(value)
