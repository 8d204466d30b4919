"""How repositories are laid out, what their ``make_env`` may look like, and what goes wrong."""

import contextlib
import os
import shutil
import sys
import venv
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorEnv

from envhub_sandbox import make_env
from envhub_sandbox.cli.shared.exits import Exit, code_for
from envhub_sandbox.errors import DependencyError, EnvHubError, LoadError, PolicyError
from tests.support.compare import assert_same
from tests.support.repositories import CARTPOLE, CARTPOLES, STILL, write_repository
from tests.support.samples import make_env_of, reference, sample


def roll(env: VectorEnv[Any, Any, Any], steps: int = 5) -> Any:
    env.reset(seed=1)
    env.action_space.seed(1)
    return [env.step(env.action_space.sample()) for _ in range(steps)][-1]


_BATCHED = """
import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Tuple

class Batched(gym.Env):
    num_envs = 1
    observation_space, action_space = Box(-1, 1, (1, 54)), Box(-1, 1, (1, 6))
    {single}

    def reset(self, *, seed=None, options=None):
        return np.zeros((1, 54), np.float32), {{}}

    def step(self, action):
        no = np.zeros(1, bool)
        return np.zeros((1, 54), np.float32), np.zeros(1), no, no, {{}}

def make_env(n_envs=1, use_async_envs=False):
    return {form}
"""


@pytest.mark.short
class TestWhereTheCodeRuns:
    """The sample ``marker`` leaves traces of where it was imported."""

    def test_only_the_worker_imports_the_repository(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The marker appears from another pid, and no module of the repository appears here."""
        marker = tmp_path / "marker.txt"
        monkeypatch.setenv("ENVHUB_MARKER", str(marker))
        before = set(sys.modules)
        with make_env(sample("marker")) as suites:
            suites.env.reset(seed=0)
            [pids] = suites.env.get_attr("import_pids")
            [pid] = suites.env.get_attr("pid")
        assert pids == [pid]
        assert not marker.exists(), "the worker saw a variable of the caller's environment"
        fresh = set(sys.modules) - before
        files = [str(getattr(sys.modules[name], "__file__", "")) for name in fresh]
        assert not [file for file in files if file.startswith(str(sample("marker")))]
        assert not {name for name in fresh if name.split(".")[0] in ("worker", "parts", "hub_env")}

    def test_without_a_sandbox_the_same_marker_names_this_process(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The control: imported in process, the marker is written, by this pid."""
        marker = tmp_path / "marker.txt"
        monkeypatch.setenv("ENVHUB_MARKER", str(marker))
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(str(sample("marker")))
        try:
            make_env_of(sample("marker"))
        finally:
            for name in [*sys.modules]:
                if name == "worker" or name.startswith("reference_samples_marker"):
                    del sys.modules[name]
        assert marker.read_text().split() == [str(os.getpid())]

    def test_siblings_assets_dataclasses_and_children_work(self) -> None:
        """Siblings, relative imports, assets by both kinds of path, postponed annotations. The
        repository's own multiprocessing gets its classes through pickle and back."""
        with make_env(sample("marker")) as suites:
            env = suites.env
            for name, value in (
                ("own_worker", "the repository's own worker.py"),
                *(
                    ("asset_by_file", "hello from an asset"),
                    ("asset_by_cwd", "hello from an asset"),
                ),
                ("settings_repr", "Settings(size=3, bolts=[Bolt(diameter=4)])"),
            ):
                assert env.get_attr(name) == (value,)
            for method in ("fork", "spawn", "forkserver"):
                assert env.call("child_says", method) == ((9, "Settings"),), method

    def test_writes_stay_in_the_scratch(self, tmp_path: Path) -> None:
        """Home, working and temporary directory can be written to, and are not the caller's."""
        with make_env(sample("scribbler")) as suites:
            [written] = suites.env.get_attr("written")
            roll(suites.env)
        assert len(set(written)) == 3
        ours = [one / "scribbled.txt" for one in (Path.home(), Path.cwd(), sample("scribbler"))]
        assert not [path for path in (*written, *ours) if Path(path).exists()]

    def test_make_env_runs_on_the_main_thread(self) -> None:
        """Signal handlers can be set at import, which only the main thread may."""
        with make_env(sample("signal_handlers"), n_envs=2) as suites:
            for moment in ("imported", "built"):
                assert suites.env.get_attr(f"{moment}_on_main_thread") == (True, True)


@pytest.mark.short
class TestLayouts:
    """Where the entry point is, and what it is."""

    def test_src_layout(self) -> None:
        with make_env(sample("src_layout"), n_envs=2) as suites:
            assert roll(suites.env)[0].shape == (2, 1)

    def test_file_in_a_sub_folder_with_impossible_names(self) -> None:
        """``:path`` names any file; its siblings and its assets are found."""
        folder = f"{sample('sub_folder')}:envs-v1/pick-cube.py"
        with make_env(folder, n_envs=2) as suites:
            assert suites.env.get_attr("colour") == ("red", "red")
            observations, *_ = roll(suites.env)
            assert observations.shape == (2,)

    @pytest.mark.parametrize(
        ("name", "use_async_envs"), [("partial_entry", False), ("async_import", True)]
    )
    def test_entry_points(self, name: str, use_async_envs: bool) -> None:
        """A ``functools.partial``; vector classes that are imported by name at the top."""
        with make_env(sample(name), n_envs=2, use_async_envs=use_async_envs) as suites:
            assert_same(roll(reference(name, 2)), roll(suites.env))

    @pytest.mark.parametrize(
        ("signature", "kwargs"),
        [
            ("make_env()", {}),
            ("make_env(n_envs)", {}),
            ("make_env(**kwargs)", {}),
            ("make_env(n_envs=1, use_async_envs=False, difficulty='easy', *, seed=None)", {}),
            ("make_env(n_envs=1, *, difficulty)", {"difficulty": "hard"}),
            ("make_env(n_envs=1, cfg=None)", {}),
        ],
    )
    def test_signatures(self, tmp_path: Path, signature: str, kwargs: dict[str, Any]) -> None:
        """``make_env`` gets those of our arguments that it takes, and ``env_kwargs``."""
        body = f"{CARTPOLES}\ndef {signature}:\n    return cartpoles(2)\n"
        folder = write_repository(tmp_path / "repo", body)
        with make_env(folder, n_envs=2, env_kwargs=kwargs) as suites:
            assert roll(suites.env)[0].shape == (2, 4)

    def test_config_object(self) -> None:
        """A config's attributes cross, also those that are no fields; dicts stay dicts."""
        cfg = SimpleNamespace(hub_path=str(sample("cfg_reader")), task="CartPole-v1")
        cfg.episode_length, cfg.camera = 3, {"width": 64}
        cfg.robot = SimpleNamespace(name="arm")
        with make_env(cfg, n_envs=2) as suites:
            env = suites.env
            names = ["camera", "episode_length", "hub_path", "robot", "task"]
            for name, value in (("told", names), ("camera_width", 64), ("robot", "arm")):
                assert env.get_attr(name) == (value, value)
            *_, truncations, _ = roll(env, steps=3)
            assert truncations.all()

    def test_cfg_is_not_passed_for_a_plain_reference(self) -> None:
        """Without a config object ``make_env`` keeps its own default for ``cfg``."""
        with pytest.raises(LoadError, match="wants a config"):
            make_env(sample("cfg_reader"))


class TestWhatMakeEnvReturns:
    """Everything becomes ``{suite: {task_id: VectorEnv}}``."""

    @pytest.mark.parametrize(("n_envs", "use_async_envs"), [(1, False), (3, True)])
    def test_single_env(self, n_envs: int, use_async_envs: bool) -> None:
        """A single Env is wrapped ``n_envs`` times; its spec names the suite."""
        with make_env(sample("single_env"), n_envs, use_async_envs) as suites:
            assert list(suites) == ["CartPole-v1"]
            assert suites.env.num_envs == n_envs
            assert_same(roll(reference("cartpole", n_envs)), roll(suites.env))

    def test_loose_suites(self) -> None:
        """A bare VectorEnv is task 0, a list counts from 0, single environments are wrapped; task
        ids may be text, with any characters."""
        with make_env(sample("loose_suites"), n_envs=2) as suites:
            tasks = {suite: list(group) for suite, group in suites.items()}
            assert tasks == {"bare": [0], "list": [0, 1], "singles": [3]}
            sizes = {env.num_envs for group in suites.values() for env in group.values()}
            assert (sizes, roll(suites["bare"][0])[0].shape) == ({2}, (2, 4))
            assert roll(suites["list"][1])[0].shape == (2, 2)
            assert roll(suites["singles"][3])[0].shape == (2, 3)
        with make_env(sample("string_tasks"), n_envs=2) as suites:
            assert list(suites["classics"]) == ["balance the pole", "climb/the-hill"]
            assert roll(suites["classics"]["climb/the-hill"])[0].shape == (2, 2)

    @pytest.mark.parametrize("form", ["{'s': {0: ENV}}", "{'s': [ENV]}", "ENV"])
    def test_a_gym_env_that_is_batched_is_a_vector(self, tmp_path: Path, form: str) -> None:
        """As LeRobot steps it, when it is in a suite: no dimension is added."""
        single = (
            "single_observation_space = Box(-1, 1, (54,)); single_action_space = Box(-1, 1, (6,))"
        )
        text = _BATCHED.format(single=single, form=form.replace("ENV", "Batched()"))
        with make_env(write_repository(tmp_path / "it", text), n_envs=1) as suites:
            env = suites.env
            assert (env.num_envs, env.single_observation_space.shape) == (1, (54,))
            assert env.reset(seed=1)[0].shape == (1, 54)
            observation, reward, *_ = env.step(env.action_space.sample())
            assert (observation.shape, reward.shape) == ((1, 54), (1,))

    @pytest.mark.parametrize("form", ["{'s': {0: Batched()}}", "gym.Wrapper(Batched())"])
    @pytest.mark.parametrize(
        "space", ["Box(-1, 1, (1, 54))", "Dict(a=Tuple((Box(-1, 1, (1, 54)), Box(-1, 1, (1,)))))"]
    )
    def test_a_batched_env_that_cannot_be_told_apart_is_refused(
        self, tmp_path: Path, form: str, space: str
    ) -> None:
        """It would get (1, 1, 54), and nothing would say why."""
        text = _BATCHED.format(single=f"observation_space = {space}", form=form)
        with pytest.raises(LoadError, match="whose num_envs is 1 and whose spaces are batched"):
            make_env(write_repository(tmp_path / "it", text), n_envs=1)

    def test_an_env_whose_spaces_follow_n_envs_is_refused(self, tmp_path: Path) -> None:
        """It is batched, though it names no number of sub-environments."""
        text = _BATCHED.format(single="", form="Batched()").replace("num_envs = 1", "rows = 1")
        text += "\n    env.observation_space = Box(-1, 1, (n_envs, 54))\n    return env\n"
        folder = write_repository(tmp_path, text.replace("return Batched()", "env = Batched()"))
        named = r"other spaces for n_envs=1.*return a gymnasium.vector"
        with pytest.raises(LoadError, match=named), make_env(folder, n_envs=3) as suites:
            suites.env.reset()

    def test_duck_typed_vector_env(self) -> None:
        """An object with the methods of a VectorEnv is one, and keeps its attributes."""
        with make_env(sample("duck_typed"), n_envs=2) as suites:
            env = suites.env
            assert env.nickname == "duck"
            assert_same(roll(reference("cartpole", 2)), roll(env))

    def test_vector_wrapper(self) -> None:
        with make_env(sample("vector_wrapper"), n_envs=2, use_async_envs=True) as suites:
            assert suites.env.factor == 0.5
            assert_same(roll(reference("vector_wrapper", 2)), roll(suites.env))

    def test_custom_vector_env(self) -> None:
        """One with its own step is compared bit for bit, infos included; its attributes are served,
        and its methods are called there."""
        expected = reference("custom_vector", 3)
        with make_env(sample("custom_vector"), n_envs=3) as suites:
            env = suites.env
            assert_same(expected.reset(seed=4), env.reset(seed=4))
            for scale in (0.1, -0.3, 1.0):
                actions = np.full((3, 1), scale, np.float32)
                assert_same(expected.step(actions), env.step(actions))
            assert_same(
                (expected.render(), {**expected.metadata}), (env.render(), {**env.metadata})
            )
            config = {"name": "swarm", "gains": [0.5, 2.0], "limits": {"speed": 1}}
            assert_same((config, False), (env.hub_config, env.initialized))
            assert env.initialize(friction=0.25) == 0.25
            assert (env.initialized, env.friction) == (True, 0.25)
            assert not hasattr(env, "no_such_thing")

    def test_an_own_attribute_that_is_not_served_is_warned_of(self, tmp_path: Path) -> None:
        """``env.sandbox`` is the client's, behind wrappers too."""
        folder = shutil.copytree(sample("custom_vector"), tmp_path / "swarm")
        entry = folder / "env.py"
        entry.write_text(entry.read_text().replace("self.friction = 0.0", "self.sandbox = 'best'"))
        with pytest.warns(UserWarning, match="named sandbox, which are not served"):
            suites = make_env(folder)
        with suites:
            suites.env.reset()
            assert {layer["layer"] for layer in suites.env.sandbox.report()} >= {"seccomp"}
            wrapped = gym.vector.VectorWrapper(suites.env)
            assert wrapped.unwrapped.sandbox.stats()["state"] == "READY"


class TestWhatGoesWrong:
    """Each failure to load has an error of its own that says where it came from."""

    @pytest.mark.parametrize(
        ("env_py", "error", "text"),
        [
            ("make_envs = 3\n", LoadError, r"did you mean 'make_envs'\?"),
            ("make_env = 3\n", LoadError, "make_env is a"),
            ("def make_env(:\n", LoadError, "SyntaxError"),
            ("import no_such_package_x\n", DependencyError, "no_such_package_x"),
            ("from gymnasium import no_such_name\n", LoadError, "no_such_name"),
            ("1 / 0\n", LoadError, "ZeroDivisionError"),
            ("def make_env(**k):\n    raise OSError('broken')\n", LoadError, "broken"),
            ("def make_env(n_envs, colour):\n    pass\n", LoadError, "colour"),
            ("def make_env(**k):\n    import no_such_package_y\n", DependencyError, "package_y"),
            ("raise SystemExit('go away')\n", EnvHubError, "go away"),
        ],
    )
    def test_failure_is_named(
        self, tmp_path: Path, env_py: str, error: type[Exception], text: str
    ) -> None:
        """The error's class says what kind of failure, its text what failed and where."""
        folder = write_repository(tmp_path / "broken", env_py)
        with pytest.raises(error, match=text) as caught:
            make_env(folder)
        assert "broken" in str(caught.value)

    def test_remote_traceback_is_text(self, tmp_path: Path) -> None:
        """What the repository raised comes with its line and its traceback, as text."""
        body = "def make_env(**k):\n    return deep()\ndef deep():\n    raise KeyError('oh')\n"
        with pytest.raises(LoadError, match=r"(?s)KeyError.*line 4, in deep\n.*oh") as caught:
            make_env(write_repository(tmp_path / "repo", body))
        assert isinstance(caught.value.__cause__, KeyError)
        assert "line 2, in make_env" in vars(caught.value)["__notes__"][0]

    def test_an_interpreter_without_our_packages_is_refused(self, tmp_path: Path) -> None:
        """The text says what to install there, and nothing crashed: there is no bundle."""
        venv.create(tmp_path / "bare", with_pip=False)
        python, crashes = str(tmp_path / "bare" / "bin" / "python"), tmp_path / "crashes"
        with pytest.raises(DependencyError, match="which the worker needs; install") as caught:
            make_env(sample("cartpole"), python=python, policy={"crash_folder": str(crashes)})
        assert str(caught.value).count(f"{python} has no ") == 1
        assert str(sample("cartpole")) in str(caught.value)
        assert code_for(caught.value) == Exit.LOAD
        assert not crashes.exists()

    def test_a_granted_path_that_is_not_there_is_refused(self, tmp_path: Path) -> None:
        """Before anything is started; one that is there is not."""
        with pytest.raises(PolicyError, match="there is no such file or folder"):
            make_env(sample("echo"), policy={"readable": (str(tmp_path / "missing"),)})
        make_env(sample("echo"), policy={"readable": (str(tmp_path),)}).close()

    def test_input_gets_end_of_file(self) -> None:
        with pytest.raises(LoadError, match="EOFError"):
            make_env(sample("prompts"))


SUITE = f"""{STILL}
BUILT = []

class Box(Still):
    def __init__(self, name):
        BUILT.append(name)

    def built(self):
        return list(BUILT)

def make_env(n_envs, use_async_envs):
    kind = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    def task(name):
        return kind([lambda i=i: Box(f"{{name}}/{{i}}") for i in range(n_envs)])
    return {{"suite": {{name: task(name) for name in ("a", "b", "c")}}}}
"""


@pytest.mark.parametrize("workers", [1, 2])
def test_a_known_task_is_all_that_its_jail_builds(tmp_path: Path, workers: int) -> None:
    """Not an environment of every task, to learn its spaces; and in each process its own slice."""
    folder = write_repository(tmp_path / "suite", SUITE)
    with make_env(folder, 2, workers > 1, num_workers=workers) as suites:
        env = suites["suite"]["b"]
        env.reset(seed=0)
        own = ["b/0", "b/1"]
        assert [*env.call("built")] == ([own, own] if workers == 1 else [own[:1], own[1:]])


CHANGING = f"""{STILL}
import time

NOW = time.time_ns()  # another in each process

class One(Still):
    def __init__(self, size):
        self.observation_space = gym.spaces.Discrete(size)

def make_env(n_envs, what):
    size = NOW % 10**9 + 2 if what == "space" else 2
    count = NOW % 10**4 + 1 if what == "count" else n_envs
    task = f"task {{NOW}}" if what == "task" else "task"
    made = {{task: vector(lambda: One(size), count), "other": vector(lambda: One(2), n_envs)}}
    return {{"suite": made}}
"""


@pytest.mark.parametrize("what", ["space", "count", "task", "nothing"])
def test_a_result_that_changes_is_refused(tmp_path: Path, what: str) -> None:
    """What was remembered of it is held against what is built; the control changes nothing."""
    folder = write_repository(tmp_path / "changing", CHANGING)
    changed = pytest.raises(LoadError, match=r"another environment for \('suite', 'task.*")
    with make_env(folder, 2, env_kwargs={"what": what}) as suites:
        env = next(iter(suites["suite"].values()))
        with contextlib.nullcontext() if what == "nothing" else changed:
            env.reset(seed=0)


class TestAFile:
    """``make_env("env.py")``, as whoever stands in the folder would write it."""

    @pytest.mark.parametrize("name", ["env.py", "nets/env.py"])
    def test_a_file_that_is_here_is_taken(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
    ) -> None:
        """Even where the Hub could have a repository of that name."""
        write_repository((tmp_path / name).parent, CARTPOLE)
        monkeypatch.chdir(tmp_path)
        with make_env(name) as suites:
            assert suites.provenance["repository"] == str((tmp_path / name).parent)
            assert suites.provenance["path"] == "env.py"
