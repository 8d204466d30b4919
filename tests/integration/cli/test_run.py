"""``envhub run``, ``inspect`` and ``diff --run``, each in a process of its own."""

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.cli.app import whole_command
from envhub_sandbox.errors import EnvHubError
from tests.hub.olah_server import OlahServer
from tests.support.command_line import document, envhub, program
from tests.support.repositories import CARTPOLE, STILL, write_repository
from tests.support.samples import EXAMPLES, sample

_PRINTS = f"""
import os
print("printed by Python")
os.system("echo printed by a child")
{CARTPOLE}"""
_ONE_ENV = f"""{STILL}
class One(Still):
    def step(self, action):
        %s
    def render(self):
        %s

def make_env(n_envs=1, use_async_envs=False, render_mode=None):
    def one():
        env = One()
        env.render_mode = render_mode
        return env
    return vector(one, n_envs)
"""


def one_env(folder: Path, step: str, render: str = "return None") -> Path:
    return write_repository(folder, _ONE_ENV % (step, render))


@pytest.mark.short
def test_a_run_prints_results_and_nothing_else() -> None:
    """The table and the provenance on stdout, on stderr only what the code sees of this machine, no
    escape sequences; what a terminal cannot show is escaped."""
    ascii_only = {"PYTHONIOENCODING": "ascii"}
    done = program("run", EXAMPLES / "cartpole", "--episodes", "4", "--n-envs", "2", **ascii_only)
    seen = f"local folder {EXAMPLES / 'cartpole'}: the code sees 1 file of it\n"
    assert (done.returncode, done.stderr) == (0, seen)
    for text in ("hub_env / 0", "steps/s", str(EXAMPLES / "cartpole"), "gymnasium", "seed 0"):
        assert text in done.stdout
    assert "\x1b" not in done.stdout


def test_json_says_what_ran_and_how() -> None:
    found = document("run", EXAMPLES / "catch", "--episodes", "5", "--n-envs", "2")
    [task] = found["tasks"]
    assert (task["suite"], task["task"], task["num_envs"]) == ("hub_env", 0, 2)
    assert sorted(episode["sub_env"] for episode in task["episodes"]) == [0, 0, 0, 1, 1]
    assert task["length"] == {"mean": 46.0, "std": 0.0, "min": 46.0, "max": 46.0}
    assert task["success_rate"] == task["return"]["mean"], "a caught ball is the only reward"
    assert found["provenance"]["commit"].startswith("local-")
    assert found["provenance"]["interpreter"]["executable"] == sys.executable
    assert any(layer["enforced"] for layer in found["provenance"]["layers"])
    assert found["error"] is None


def test_inspect_steps_nothing(tmp_path: Path) -> None:
    folder = one_env(tmp_path / "one", "raise RuntimeError('stepped')")
    found = document("inspect", folder, "--n-envs", "3")
    [env] = found["envs"]
    assert (env["num_envs"], env["single_action_space"]) == (3, "Discrete(2)")
    assert env["action_space"] == "MultiDiscrete([2 2 2])"
    text = envhub("inspect", folder).stdout
    assert ("Discrete(2)" in text, "NextStep" in text) == (True, True)


def test_a_video_is_written_and_plays(tmp_path: Path) -> None:
    """One frame per state of the first sub-environment: resets included, its last frame too. Of
    several tasks each has one; their names are a stranger's, and make no file names."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "out.mp4"
    arguments = ("--episodes", "4", "-n", "2", "--video", path)
    found = document("run", EXAMPLES / "catch", *arguments)
    assert found["tasks"][0]["video"] == str(path)
    assert imageio_ffmpeg.count_frames_and_secs(str(path))[0] == 2 * (46 + 1)
    meta = next(imageio_ffmpeg.read_frames(str(path)))
    assert (meta["size"], meta["fps"]) == ((64, 64), 20.0)
    several = ("--episodes", "1", "--video", tmp_path / "several" / "out.mp4")
    (tmp_path / "several").mkdir()
    assert envhub("run", EXAMPLES / "two_tasks", *several).returncode == 0
    made = sorted(path.name for path in (tmp_path / "several").iterdir())
    assert made == ["out-1.mp4", "out-2.mp4"]


OVER = "return 0, 1.0, True, False, {}"
FAILURES: list[tuple[str, Sequence[str], int, str]] = [
    ("raise ValueError('no such luck')", (), 1, "ValueError: no such luck"),
    (OVER, ("--task", "7"), 2, "hub_env/0"),
    (OVER, ("--actions", "clever"), 2, "clever"),
    ("import os; os._exit(3)", (), 5, "exit code 3"),
    ("import time; time.sleep(600)", ("--timeout", "5"), 5, "5.0 s"),
]


@pytest.mark.short
@pytest.mark.parametrize(("step", "arguments", "code", "says"), FAILURES)
def test_failures_have_a_code_and_a_message(
    tmp_path: Path, step: str, arguments: Sequence[str], code: int, says: str
) -> None:
    """Nothing on stdout, no traceback, and the exit code that the documentation names."""
    done = envhub("run", one_env(tmp_path / "one", step), *arguments)
    assert (done.returncode, done.stdout) == (code, ""), done.stderr
    assert says in done.stderr
    assert "Traceback" not in done.stderr


def test_stopping_early_is_said(tmp_path: Path) -> None:
    """An environment that never ends can be tried with ``--steps``."""
    endless = one_env(tmp_path / "one", "return 0, 1.0, False, False, {}")
    done = envhub("run", endless, "--steps", "20", code=0)
    assert "0 (stopped)" in done.stdout
    assert "stopped by --steps" in done.stderr


def test_a_repository_that_does_not_load(tmp_path: Path) -> None:
    folder = write_repository(tmp_path / "bad", "import this_is_not_installed\n")
    done = envhub("run", folder, code=4)
    assert "this_is_not_installed" in done.stderr
    assert "Traceback" not in done.stderr
    assert "Traceback" in envhub("run", folder, "--debug").stderr


def hostile_names(folder: Path, suite: str, task: str) -> Path:
    code = _ONE_ENV % (OVER, "return None")
    code += f"""
def make_env(n_envs=1, use_async_envs=False):
    return {{{suite!r}: {{{task!r}: vector(One, 1)}}}}
"""
    return write_repository(folder, code)


def test_names_with_control_characters_are_refused(tmp_path: Path) -> None:
    done = envhub("run", hostile_names(tmp_path / "evil", "\x1b]0;owned\x07", "\x1b[2J"))
    assert (done.returncode, done.stdout) == (5, "")
    assert "control characters" in done.stderr
    assert "\x1b" not in done.stderr


def test_markup_and_messages_are_shown_as_text(tmp_path: Path) -> None:
    """Markup in names and escape sequences in messages of a stranger do nothing to the terminal."""
    folder = hostile_names(tmp_path / "evil", "[bold]s[/bold]", "[red]x[/red]")
    for command in ("run", "inspect"):
        done = envhub(command, folder, code=0)
        assert "[bold]s[/bold] / [red]x[/red]" in done.stdout.replace("\n", "")
    noisy = envhub("run", sample("noisy"))
    assert r"\x1b[2J" in noisy.stderr
    assert "\x1b" not in noisy.stderr


def test_without_a_sandbox_it_runs_here_when_trusted(tmp_path: Path) -> None:
    """And says that nothing confined it; its own errors are still its own."""
    done = program("run", EXAMPLES / "cartpole", "--sandbox", "none", "--trust-remote-code", code=0)
    assert "nothing: the code ran in this process" in done.stdout
    folder = one_env(tmp_path / "one", "return {}['missing']")
    failed = program("run", folder, "--sandbox", "none", "--trust-remote-code", code=1)
    assert "KeyError: 'missing'" in failed.stderr


def test_prints_stay_off_stdout_without_a_sandbox(tmp_path: Path) -> None:
    """It has the results and nothing else, whoever prints in this process or below it."""
    folder = write_repository(tmp_path / "prints", _PRINTS)
    done = program("run", folder, "--sandbox", "none", "--trust-remote-code", "--json", code=0)
    json.loads(done.stdout)
    assert all(f"printed by {one}" in done.stderr for one in ("Python", "a child")), done.stderr


def test_output_and_life_of_a_jail_go_where_they_are_wanted(tmp_path: Path) -> None:
    """Its output to a file, ``--verbose`` to stderr; the bundle of a death is for programs, too."""
    dies = ("--env-kwargs", "moment=step", "--env-kwargs", "fault=exit")
    kept = ("--worker-output", tmp_path / "worker.log", "--verbose", "--json")
    done = envhub("run", sample("faulty"), *dies, *kept)
    assert (done.returncode, (tmp_path / "worker.log").read_text()) == (5, "about to exit\n")
    assert ("opened" in done.stderr, "closes" in done.stderr) == (True, True)
    assert (Path(json.loads(done.stdout)["error"]["bundle"]) / "bundle.json").exists()


def test_diff_compares_spaces_where_that_is_asked_for(tmp_path: Path) -> None:
    """Without ``--run`` nothing is known of them."""
    old = write_repository(tmp_path / "old", CARTPOLE)
    new = write_repository(tmp_path / "new", CARTPOLE.replace("CartPole-v1", "Acrobot-v1"))
    read = envhub("diff", old, new)
    assert (read.returncode, "Discrete" in read.stdout) == (7, False), read.stderr
    ran = envhub("diff", old, new, "--run", code=7)
    assert "actions were Discrete(2), now Discrete(3)" in ran.stdout


@pytest.fixture
def hub(olah: OlahServer, hub_cache: Path) -> list[str]:
    return ["--endpoint", olah.endpoint, "--hub-cache-dir", str(hub_cache)]


def test_a_repository_of_the_hub_runs(
    olah: OlahServer, hub: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commit is in the provenance, nothing but results is printed, and then it needs no Hub."""
    code = (EXAMPLES / "cartpole" / "env.py").read_text()
    commit = olah.repository("org/cli-runs", "model").commit({"env.py": code})
    named = envhub("run", "org/cli-runs@main", "--episodes", "2", *hub)
    assert (named.returncode, named.stderr) == (0, "")
    assert f"org/cli-runs (model) at {commit}, env.py" in named.stdout
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    pinned = envhub("run", f"org/cli-runs@{commit}", "--episodes", "2", "--json", *hub)
    assert json.loads(pinned.stdout)["provenance"]["commit"] == commit
    listed = envhub("cache", "list", "--json")
    assert [one["commit"] for one in json.loads(listed.stdout)["snapshots"]] == [commit]


# --- What an error advises is an option of the place that one is at

_WANTS = "import nothing_of_this_name\n\ndef make_env(n_envs=1, use_async_envs=False): pass\n"
_SLOW = "import time\n\ndef make_env(n_envs=1, use_async_envs=False): time.sleep(3600)\n"
_IN_PYTHON = re.compile(r"\b(?:dependencies|policy|timeouts|limits|python|sandbox)=|Policy\(")
EXTRA = """--dependencies '{"extra": ["NAME-OF-THE-PACKAGE"]}'"""


def said(command: str, *arguments: str | Path) -> str:
    """The error of a command, on one line; it names no option that the command does not have."""
    done = envhub(command, *arguments)
    assert done.returncode != 0
    text = " ".join(done.stderr.split())
    options = {option for one in whole_command(command).params for option in one.opts}
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)) <= options | {"--debug"}
    return text


@pytest.mark.parametrize("command", ["run", "lock"])
def test_a_missing_module(command: str, tmp_path: Path) -> None:
    """The package joins it by an option; in Python by an argument."""
    folder = write_repository(tmp_path / "wants", _WANTS)
    own = tmp_path / "pylock.toml"
    further = ["--output", own] if command == "lock" else []
    text = said(command, folder, *further)
    assert ("nothing_of_this_name" in text, EXTRA in text) == (True, True)
    assert not _IN_PYTHON.search(text)
    with pytest.raises(EnvHubError, match=r"dependencies=\{'extra': \['NAME-OF-THE-PACKAGE'\]\}"):
        make_env(folder)


def test_a_make_env_that_takes_too_long(tmp_path: Path) -> None:
    """Where a command has no such option, Python's is named as such."""
    folder = write_repository(tmp_path / "slow", _SLOW)
    text = said("run", folder, "--timeout", "1")
    assert "raise --timeout 2.0" in text
    assert not _IN_PYTHON.search(text)
    with pytest.raises(EnvHubError, match=r"raise timeouts=\{'startup_s': 2"):
        make_env(folder, timeouts={"startup_s": 1})
