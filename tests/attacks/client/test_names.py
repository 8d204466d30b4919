"""A hostile worker against what programs do with any object: copy, print, display, convert, make.
Libraries call methods that the caller never wrote. The controls do the same with a proxy that
serves whatever a manifest lists, and with what a worker sent unchecked: there the attack works.
What counts is what the worker heard, which memory was read or written, and which files appeared."""

import contextlib
import copy
import ctypes
import gc
import html
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorWrapper
from gymnasium.vector.utils import batch_space

from envhub_sandbox import make_env
from envhub_sandbox.errors import RemoteProtocolError, WorkerDiedError
from envhub_sandbox.vector.single_env import SingleEnv
from envhub_sandbox.vector.sub_environment import SubEnvironment
from envhub_sandbox.vector.suites import EnvSuites
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest.names import GYMNASIUMS, PROBED
from envhub_worker.protocol.spaces.spaces import encode_space
from tests.attacks.client.lies import SCRIPT, opened, relayed, spec_of
from tests.attacks.client.lying_server import ACTION, OBSERVATION, Lie, LyingServer, manifest
from tests.attacks.harness import Arena
from tests.support import inside
from tests.support.objects import curious
from tests.support.objects.curious import do, names_asked_for
from tests.support.repositories import write_repository

FAMILY = "The client, by what libraries do with any object"
TOKEN = "hf_canary_of_the_caller_0123456789"
HTML, ENSURE = "_repr_html_", "_ensure"
ASKED = {
    "pandas": {"toDict", "dtype", "ndim", "read", "write", "keys"},
    "matplotlib": {"shape", "values", "index", "to_numpy"},
    "numpy": {"size", "shape", "ndim", "dtype", "imag", "__array_interface__", "__array__"},
    "IPython": {"getdoc", "_repr_html_", "_ipython_display_", "_repr_mimebundle_"},
    "rich": {"__rich_console__", "_fields"},
    "torch": {"pin_memory", "__cuda_array_interface__"},
    "tqdm": {"shape"},
    "copy": {"__deepcopy__"},
}
"""Some of what libraries look for in any object, to see that they are really asked here."""


def greedy(liar: LyingServer, folder: str, answer: Lie | None = None, **fields: Any) -> EnvSuites:
    value = manifest()
    # a manifest holds 1024 names: those that the tests below turn on come first
    first = ("__deepcopy__", "__array_interface__", "_repr_html_", "__html__", "hub_config")
    listed = tuple(dict.fromkeys((*first, *sorted(names_asked_for()))))[:1024]
    value["envs"][0].update({"attributes": listed, "shardable": False, **fields})
    liar.lies[m.Load] = relayed(m.LoadDone(value))
    liar.lies[m.Build] = relayed(m.BuildDone(value["envs"][0]))
    liar.lies[m.GetOne] = answer or relayed(m.Method())
    liar.lies[m.CallOne] = relayed(m.Value(SCRIPT))
    return opened(liar, folder)


OF_ONE: dict[str, Any] = {
    "num_envs": 1,
    "observation_space": encode_space(batch_space(OBSERVATION, 1)),
    "action_space": encode_space(batch_space(ACTION, 1)),
}
"""What a manifest says of a vector environment of one."""


class Naive:
    """The control: a proxy that serves what a manifest lists, as ``__getattr__`` invites to."""

    def __init__(self, env: SandboxVectorEnv, *listed: str) -> None:
        self._env = env
        self._listed = listed

    def __getattr__(self, name: str) -> Any:
        if name not in self.__dict__.get("_listed", ()):
            raise AttributeError(name)
        reply = self._ask(m.GetOne, name)
        if isinstance(reply, m.Value):
            return reply.value

        def method(*args: Any, **kwargs: Any) -> Any:
            result = self._ask(m.CallOne, name, args, kwargs)
            return result.value

        return method

    def _ask(self, kind: type[Any], *fields: Any) -> m.Message:
        def message(number: int, row: int | None) -> m.Message:
            asked: m.Message = kind(number, row, 0, *fields)
            return asked

        return inside.session(self._env).requests.ask_one("ask", m.ITSELF, message)


class Forwarding(VectorWrapper):
    """A wrapper that forwards every attribute that it lacks, as Gymnasium's own once did."""

    def __getattr__(self, name: str) -> Any:
        if name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)


WRAPS: list[Callable[[Any], Any]] = [
    *(lambda env: env, VectorWrapper, Forwarding, lambda env: env.envs[0])
]


def asked_for(liar: LyingServer) -> set[str]:
    kinds = (m.Call, m.GetOne, m.CallOne)
    return {request.name for request in liar.asked if isinstance(request, kinds)}


# --- copying --------------------------------------------------------------------------------


def test_copies_are_fresh_and_hand_no_more(liar: LyingServer, folder: str) -> None:
    """Copying a config that holds an environment does not send the rest of it to the jail."""
    with greedy(liar, folder) as suites:
        env = suites.env
        for wrap in WRAPS:
            copied = copy.deepcopy([TOKEN, wrap(env)])
            assert type(copied[1]) is type(wrap(env))
            assert copied[1] is not env
        for made in (copy.copy(env), copy.deepcopy(env)):
            assert type(made) is type(env)
            assert made is not env
            made.close()
            assert not env.closed
        for many in (copy.copy(suites), copy.deepcopy(suites)):
            assert many.env is not env
            many.close()
        assert not asked_for(liar)
        assert TOKEN.encode() not in liar.heard
        copy.deepcopy([TOKEN, Naive(env, "__deepcopy__")])
        assert TOKEN.encode() in liar.heard, "the control failed: a naive proxy hands it over"


# --- arrays ---------------------------------------------------------------------------------


def interface_of(memory: Any) -> Lie:
    """A worker that calls memory of the client its array."""
    address = ctypes.addressof(memory)
    shape = (len(memory),)
    interface = {"shape": shape, "typestr": "|u1", "data": (address, False), "version": 3}
    return relayed(m.Value(interface))


def of_torch() -> list[Callable[[Any], object]]:
    with contextlib.suppress(ImportError):
        torch: Any = importlib.import_module("torch")
        return [torch.as_tensor, torch.tensor, torch.from_dlpack]
    return []


def test_numpy_reads_and_writes_no_memory(liar: LyingServer, folder: str) -> None:
    """An environment is one object to numpy, wherever the worker says that its array lies."""
    memory = ctypes.create_string_buffer(TOKEN.encode())
    with greedy(liar, folder, interface_of(memory)) as suites:
        for env in (wrap(suites.env) for wrap in WRAPS):
            for made in (np.asarray(env), np.array([env], object)):
                assert made.dtype == object
                assert made.item() is env
            with pytest.raises(TypeError):
                np.asarray(env, np.float32)
            for convert in (np.from_dlpack, memoryview, bytes, bytearray, *of_torch()):
                with pytest.raises((TypeError, RuntimeError, AttributeError)):
                    convert(env)
        assert not asked_for(liar)

        stolen = np.asarray(Naive(suites.env, "__array_interface__"))
        assert stolen.tobytes()[: len(TOKEN)] == TOKEN.encode(), "the control reads nothing"
        stolen[:2] = ord("X")
        assert memory.value.startswith(b"XX"), "the control writes nothing"
        del stolen
        gc.collect()


# --- notebooks and templates ----------------------------------------------------------------


def displayed(thing: Any) -> dict[str, str]:
    """What IPython shows; where it is not installed, what it would begin with."""
    with contextlib.suppress(ImportError):
        formatters: Any = importlib.import_module("IPython.core.formatters")
        return dict(formatters.DisplayFormatter().format(thing)[0])
    return {"text/html": getattr(thing, HTML)()} if hasattr(thing, HTML) else {}


def templated(thing: Any) -> str:
    """What a template shows, by the rule of markupsafe."""
    return str(thing.__html__()) if hasattr(thing, "__html__") else html.escape(str(thing))


def test_notebooks_show_the_clients_own_text(liar: LyingServer, folder: str) -> None:
    """Of suites, too: their names are escaped in HTML, and nobody is asked for them."""
    with greedy(liar, folder, suite=SCRIPT) as suites:
        for env in (wrap(suites.env) for wrap in WRAPS):
            own = getattr(env, HTML)() if isinstance(env, SandboxVectorEnv) else ""
            assert SCRIPT not in own + templated(env)
            assert SCRIPT not in "".join(displayed(env).values())
        shown = displayed(suites)["text/html"]
        assert SCRIPT not in templated(suites) + shown
        assert html.escape(SCRIPT) in shown, "the control shows no suite"
        assert not asked_for(liar)
        naive = Naive(suites.env, "__html__", "_repr_html_")
        assert SCRIPT in templated(naive), "the control shows nothing"
        assert SCRIPT in displayed(naive).get("text/html", ""), "the control shows nothing"


# --- every name -----------------------------------------------------------------------------


def test_no_name_that_a_library_looks_for_reaches_the_wire(liar: LyingServer, folder: str) -> None:
    """Not one of them is asked of a worker that lists them all; honest ones are.
    Found out by doing it: copying, converting, showing and inspecting an object that listens."""
    names = names_asked_for()
    for library, some in ASKED.items():
        if importlib.util.find_spec(library):
            assert some <= names, f"{library}: it no longer asks, or cannot be asked like this"
    listed = (*sorted(names), "hub_config", "task_description", "_ensure")
    with greedy(liar, folder, attributes=listed) as suites:
        env = suites.env
        for name in listed[:-3]:
            for thing in (env, Forwarding(env), env.envs[0], VectorWrapper(env)):
                if not hasattr(type(thing), name):
                    getattr(thing, name, None)
        assert not asked_for(liar)
        for name in listed[-3:]:
            getattr(env, name)
        assert asked_for(liar) == set(listed[-3:]), "the control failed: nothing is asked"
        Naive(env, "__array_interface__").__array_interface__  # noqa: B018
        assert "__array_interface__" in asked_for(liar)


def test_what_libraries_do_with_any_object_reaches_no_worker(
    liar: LyingServer, folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Converting, printing, plotting, logging, copying and comparing asks a worker for nothing."""
    innermost: Any = SubEnvironment.unwrapped

    def unwrapped(sub: SubEnvironment) -> Any:
        if len(liar.asked) > 200:  # pandas follows it a thousand times, which is the same again
            raise AttributeError
        return innermost.fget(sub)

    monkeypatch.setattr(SubEnvironment, "unwrapped", property(unwrapped))
    listed = (*sorted(PROBED), "hub_config", "task_description")
    answer = relayed(m.Value((1,)))
    liar.lies |= {m.GetOne: answer, m.Call: answer, m.CallOne: answer, m.GetRandom: answer}
    with greedy(liar, folder, answer, attributes=listed, **OF_ONE) as suites:
        env = suites.env
        for thing in (env, env.envs[0], SingleEnv(env), VectorWrapper(env)):
            for act in curious.ACTS:
                do(act, thing)
                assert not asked_for(liar) - GYMNASIUMS, act  # properties that dir() names
                liar.asked.clear()
            env.hub_config  # noqa: B018
            assert "hub_config" in asked_for(liar), "the control failed: nothing can be asked"
            liar.asked.clear()
        # the control: a proxy that serves what is listed is asked
        for act in curious.ACTS:
            do(act, Naive(env, *listed))
        assert asked_for(liar) >= {"shape", "ndim", "size", "index", "keys"}


def test_what_libraries_look_for_is_served_to_who_names_it(liar: LyingServer, folder: str) -> None:
    """``size`` is an attribute of many environments: asked for by name, it is what it is."""
    with greedy(liar, folder, attributes=("size", "to"), **OF_ONE) as suites:
        liar.lies |= {m.GetOne: relayed(m.Value(8)), m.Call: relayed(m.Value((8,)))}
        liar.lies[m.CallOne] = relayed(m.Value(True))
        env = suites.env
        single = SingleEnv(env)
        for thing, ask in ((env, "get_attr"), (single, "get_wrapper_attr"), (env.envs[0], "get_w")):
            with pytest.raises(AttributeError, match=rf"{ask}.*'size'"):
                thing.size  # noqa: B018
        assert not asked_for(liar)
        assert env.get_attr("size") == env.call("size") == (8,)
        assert env.envs[0].get_wrapper_attr("size") == single.get_wrapper_attr("size") == 8
        assert gym.Wrapper(single).get_wrapper_attr("size") == 8
        assert single.has_wrapper_attr("size")
        assert single.get_wrapper_attr("spec") is single.spec


def test_the_clients_own_names_are_nobody_elses(liar: LyingServer, folder: str) -> None:
    """A property of ours that fails does not fall back to the worker's attribute of that name."""
    own = tuple(name for name in dir(SandboxVectorEnv) if not name.startswith("__"))
    liar.lies[m.GetRandom] = relayed(
        m.RaisedException("AttributeError", "AttributeError", "no", "", "x")
    )
    with greedy(liar, folder, attributes=own) as suites:
        with pytest.raises(AttributeError):
            suites.env.np_random  # noqa: B018
        assert "np_random" not in asked_for(liar)


def test_sub_environments_run_nothing_when_looked_at(liar: LyingServer, folder: str) -> None:
    """``hasattr(env.envs[0], "reset")`` does not reset; what is no method of ours is asked for."""
    with greedy(liar, folder) as suites:
        sub = suites.env.envs[0]
        for name in ("reset", "step", "close", "render", "unwrapped"):
            assert hasattr(sub.unwrapped, name)
        assert not asked_for(liar)
        liar.lies[m.GetOne] = relayed(m.Method())
        liar.lies[m.CallOne] = relayed(m.Value("lift"))
        method = sub.task
        assert asked_for(liar) == {"task"}
        assert not any(isinstance(request, (m.Reset, m.CallOne)) for request in liar.asked)
        assert method(1) == "lift"
        assert any(isinstance(request, m.CallOne) for request in liar.asked)
        liar.lies[m.GetOne] = relayed(m.Value("lift"))
        assert sub.task == "lift"


@pytest.mark.parametrize("lie", [m.Done(), m.ResetDone(0, {}), m.BuildDone({})], ids=repr)
def test_sub_environments_take_only_values_and_methods(
    liar: LyingServer, folder: str, lie: m.Message
) -> None:
    with greedy(liar, folder) as suites:
        liar.lies |= {m.GetOne: relayed(lie), m.CallOne: relayed(lie)}
        sub = suites.env.envs[0]
        for ask in (lambda: sub.task, lambda: sub.reset(), lambda: sub.spec):
            with pytest.raises((RemoteProtocolError, WorkerDiedError)):
                ask()


# --- a real jail ----------------------------------------------------------------------------

_TRAP = """
import gymnasium as gym, numpy as np
from gymnasium.envs.registration import EnvSpec
from envhub_worker.runner import manifest as describe

class Trap(gym.vector.SyncVectorEnv):
    hub_config = {{"robot": "so100"}}
    loot = ""

    def _ensure(self):
        return "ensured"

    def _repr_html_(self):
        return {script!r}

    __html__ = _repr_html_

    def render(self):
        return ({script!r},) * self.num_envs

    def __deepcopy__(self, memo):
        self.loot = repr(memo)
        return self

# what our own code in the jail leaves out, the repository puts in again
describe._attributes = lambda env: (
    "hub_config", "loot", "_ensure", "_repr_html_", "__html__", "__deepcopy__")
describe._spec = lambda env: {spec!r}

def make_env(n_envs=1, use_async_envs=False):
    env = Trap([lambda: gym.make("CartPole-v1")] * n_envs)
    env.spec = EnvSpec(**{spec!r})
    return env
"""


def attempts(env: Any, canary: Path) -> dict[str, bool]:
    canary.unlink(missing_ok=True)
    copied = copy.deepcopy([TOKEN, env])
    copied[1].close()
    with contextlib.suppress(Exception):
        gym.make(env.spec).close()
    assert env.render()[0] == SCRIPT  # of which a notebook shows frames alone
    return {
        "have a deep copy hand over what else is copied": TOKEN in env.loot,
        "put script into the caller's notebook": SCRIPT in "".join(displayed(env).values()),
        "put script into the caller's page": SCRIPT in templated(env),
        "have gym.make(env.spec) run a command": canary.exists(),
    }


def test_a_jail_that_lists_everything_serves_what_is_honest(arena: Arena, home: Path) -> None:
    """Our own filter in the jail is no filter: the repository replaces it, and gains nothing."""
    canary = home / "made"
    source = _TRAP.format(script=SCRIPT, spec=spec_of(canary))
    trap = str(write_repository(home / "trap", source))
    with make_env(trap, n_envs=2, sandbox=None, trust_remote_code=True) as suites:
        control = attempts(suites.env, canary)
        assert all(control.values()), control
    with make_env(trap, n_envs=2, **arena.place({})) as suites:
        env = suites.env
        env.reset(seed=0)
        assert (env.hub_config, getattr(env, ENSURE)()) == ({"robot": "so100"}, "ensured")
        for title, through in attempts(env, canary).items():
            arena.judge(title, "succeeds", through, "")
        assert np.asarray(env).item() is env
