"""What an environment raises leads to the line that raised it, in a real jail."""

import traceback
from pathlib import Path
from typing import Any

import pytest

import envhub_sandbox
from envhub_sandbox import SandboxEnv, make_env
from envhub_sandbox.errors import EnvHubError, LoadError
from envhub_worker.protocol.text import MARGIN
from tests.support.repositories import write_repository

PACKAGE = str(Path(envhub_sandbox.__file__).parent)
ENV = """
import gymnasium as gym
from parts.motor import turn

class Motor(gym.Env):
    observation_space = gym.spaces.Discrete(2)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return 0, {}

    def step(self, action):
        return turn(action), 0.0, False, False, {}

def make_env(n_envs=1, use_async_envs=False, broken=False):
    if broken:
        turn(0)
    return gym.vector.SyncVectorEnv([Motor] * n_envs)
"""
MOTOR = "def turn(angle):\n    raise ZeroDivisionError('stuck')\n"


def repository(folder: Path, text: str = ENV) -> Path:
    (folder / "mine" / "parts").mkdir(parents=True)
    (folder / "mine" / "parts" / "motor.py").write_text(MOTOR)
    return write_repository(folder / "mine", text)


def failure(reference: str, *, at: str, **options: Any) -> EnvHubError:
    broken = {"broken": True} if at == "make_env" else None
    with pytest.raises(ZeroDivisionError, match="stuck") as caught:
        play(reference, env_kwargs=broken, **options)
    assert isinstance(caught.value, EnvHubError)
    return caught.value


def play(reference: str, **options: Any) -> None:
    with make_env(reference, **options) as suites:
        suites.env.reset(seed=0)
        suites.env.step([0])


def play_one(reference: str, **options: Any) -> None:
    """The same, of a ``gymnasium.Env``."""
    with SandboxEnv(reference, **options) as env:
        env.reset(seed=0)
        env.step(0)


@pytest.mark.parametrize(
    ("at", "lane"), [("step", "auto"), ("step", "frames"), ("make_env", "auto")]
)
def test_the_line_in_the_authors_own_folder(tmp_path: Path, at: str, lane: str) -> None:
    folder = repository(tmp_path)
    error = failure(str(folder), at=at, policy={"lane": lane})
    where = f'  File "{folder}/parts/motor.py", line 2, in turn\n'
    assert str(error).endswith(f"{where}    raise ZeroDivisionError('stuck')")
    [note] = vars(error)["__notes__"]
    place, line = ("make_env", 17) if at == "make_env" else ("step", 13)
    assert f'File "{folder}/env.py", line {line}, in {place}\n' in note
    assert note.count("File ") == 2, note


@pytest.mark.parametrize(("lane", "workers"), [("auto", 1), ("auto", 2), ("frames", 2)])
def test_a_result_that_does_not_fit_is_located(tmp_path: Path, lane: str, workers: int) -> None:
    """With the call, the sub-environment among all of them, and what its space says."""
    text = ENV.replace("return 0, {}", "self.angle = [0, 1.5][seed - 2]\n        return 0, {}")
    folder = repository(tmp_path, text.replace("turn(action)", "self.angle"))
    with make_env(str(folder), n_envs=2, policy={"lane": lane}, num_workers=workers) as suites:
        suites.env.reset(seed=[2, 3])
        with pytest.raises(TypeError) as caught:
            suites.env.step([0, 0])
    told = "step of sub-environment 1 returned float 1.5, its observation_space is Discrete(2)"
    line = "return self.angle, 0.0, False, False, {}"
    where = f'  File "{folder}/env.py", line 14, in step\n    {line}'
    assert str(caught.value).endswith(f"TypeError: {told}\n{where}")


@pytest.mark.parametrize(
    ("at", "lane", "shown"),
    [
        ("step", "frames", "folded"),
        ("single", "auto", "folded"),
        ("make_env", "auto", "folded"),
        ("step", "auto", "full"),
    ],
)
def test_a_traceback_has_one_frame_of_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str, lane: str, shown: str
) -> None:
    """Between the caller's last line and the author's; all of them, where that is asked for."""
    monkeypatch.setenv("ENVHUB_TRACEBACK", shown)
    folder = repository(tmp_path)
    broken = {"broken": True} if at == "make_env" else None
    with pytest.raises(ZeroDivisionError) as caught:
        (play_one if at == "single" else play)(
            str(folder), env_kwargs=broken, policy={"lane": lane}
        )
    files = [frame.filename for frame in traceback.extract_tb(caught.value.__traceback__)]
    ours = [name for name in files if name.startswith(PACKAGE)]
    assert files[: -len(ours)] == [__file__] * 2
    assert len(ours) == 1 if shown == "folded" else len(ours) > 3, ours


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("env.py", "import gymnasium\n\ndef make_env(:\n    pass\n"),
        ("env.py", "def make_env(n_envs=1):\n\tif n_envs:\n\t\treturn 1 +\t* 2\n"),
        ("parts/motor.py", "def turn(angle):\n    value = (angle +\n    return value\n"),
    ],
    ids=["entry", "tabs", "imported"],
)
def test_a_syntax_error_is_shown_as_python_shows_it(tmp_path: Path, name: str, source: str) -> None:
    """File, line and caret: what the same file gives in this process, without a sandbox."""
    folder = repository(tmp_path, "import parts.motor\n")
    (folder / name).write_text(source)
    with pytest.raises(SyntaxError) as here:
        compile(source, str(folder / name), "exec")
    *place, _ = "".join(traceback.format_exception_only(here.value)).splitlines()
    with pytest.raises(LoadError) as caught:
        make_env(str(folder))
    assert str(caught.value).splitlines()[-3:] == [
        line.replace("    \t\t", "    ").replace("\t", " ") for line in place
    ]
    [note] = vars(caught.value)["__notes__"]
    assert "\n".join(place) in note.replace(f"\n{MARGIN}", "\n")
    # the import of what is broken, where it is not the entry file, and no line of ours
    assert note.count("File ") == (1 if name == "env.py" else 2), note
