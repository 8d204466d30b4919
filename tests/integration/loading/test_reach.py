"""What an environment wants when it starts: command line, home, sockets, downloads and windows."""

from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import errors, make_env
from tests.support.repositories import STILL, write_repository

PARSES = f"""
import argparse, sys
parser = argparse.ArgumentParser()
parser.add_argument("--level", type=int, ARGUMENTS)
LEVEL = parser.parse_args().level
{STILL}
class Told(Still):
    def argv(self):
        return list(sys.argv)
"""
RUNS = f"""
import os, socket, subprocess, sys, urllib.request
{STILL}
class Runs(Still):
    def run(self, code):
        exec(code, globals())
"""


def test_a_command_line_is_parsed(tmp_path: Path) -> None:
    """``sys.argv`` is the entry file and nothing else."""
    folder = write_repository(tmp_path / "repo", PARSES.replace("ARGUMENTS", "default=3"))
    with make_env(str(folder)) as suites:
        assert suites.env.call("argv") == (["env.py"],)


def test_argparse_that_leaves_shows_its_usage(tmp_path: Path) -> None:
    """Instead of ``SystemExit: 2``, which says nothing."""
    folder = write_repository(tmp_path / "repo", PARSES.replace("ARGUMENTS", "required=True"))
    with pytest.raises(errors.LoadError) as caught:
        make_env(str(folder))
    assert "usage: env.py [-h] --level LEVEL" in str(caught.value)
    assert "the following arguments are required: --level" in str(caught.value)


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = write_repository(tmp_path_factory.mktemp("runs") / "repo", RUNS)
    with make_env(str(folder), policy={"restart": "on_reset"}) as suites:
        yield suites.env


@pytest.mark.parametrize("name", ["model.xml", "data/a b.npy", "other.py", "lib/other.py"])
@pytest.mark.parametrize("when", ["in make_env", "later"])
def test_what_is_beside_a_named_file_is_missed_aloud(tmp_path: Path, name: str, when: str) -> None:
    """That it is there, why the code does not see it, and which reference shows it."""
    code = "sys.path.append('lib')\n__import__('oth' + 'er')"
    code = code if name.endswith("other.py") else f"open({name!r})"
    folder = write_repository(
        tmp_path / "repo", RUNS + f"\n{code if when == 'in make_env' else ''}"
    )
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text("")
    word = rf"{name!r} is there, in {folder}, but a file .*name that with .*: '{folder}:env\.py'"
    expected = (errors.LoadError, errors.DependencyError, errors.RemoteEnvError)
    with pytest.raises(expected, match=word) as caught, make_env(folder / "env.py") as suites:
        suites.env.call("run", code)
    assert "environment of its own" not in str(caught.value)
    with make_env(f"{folder}:env.py") as suites:
        suites.env.call("run", code)


URL = "http://envhub.example/x"
PIP = "[sys.executable, '-m', 'pip', 'install', 'no-such-one']"


@pytest.mark.parametrize(
    ("code", "advice"),
    [
        ("from huggingface_hub import snapshot_download as s; s('org/other')", "with assets="),
        ("from huggingface_hub import hf_hub_download as h; h('org/other', 'x')", "with assets="),
        (f"urllib.request.urlopen({URL!r})", "assets=['org/repo@COMMIT'] names"),
        (f"subprocess.run(['git', 'clone', {URL!r}, '/tmp/x'], check=True)", "] names"),
        (f"subprocess.run({PIP}, check=True)", "dependencies={'extra': ['no-such-one']}"),
        ("input()", "policy={'environment': ['NAME']}"),
        ("subprocess.check_call('pip install -q no-such-one', shell=True)", "requirements.txt"),
        ("socket.create_server(('127.0.0.1', 0))", "policy={'network': 'loopback'}"),
        ("socket.create_connection(('localhost', 1))", "policy={'network': 'loopback'}"),
        ("raise RuntimeError('could not connect to display')", "render to arrays"),
    ],
)
def test_what_is_not_there_fails_with_what_brings_it(env: Any, code: str, advice: str) -> None:
    """One sentence, which names the argument; the program's own words stay."""
    env.reset()
    with pytest.raises(errors.RemoteEnvError) as caught:
        env.call("run", code)
    assert advice in str(caught.value)
    assert str(caught.value).lower().count("a jail has no ") == 1


@pytest.mark.filterwarnings("default")
def test_lerobot_that_is_imported_for_an_annotation_needs_no_package(tmp_path: Path) -> None:
    """A stub stands in, nothing is installed, and the caller is warned of it."""
    code = f"""
from lerobot.envs.configs import EnvConfig, HubEnvConfig
from lerobot.utils.constants import OBS_STATE
{STILL}
def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: EnvConfig | None = None):
    return vector(Still, n_envs)
"""
    folder = write_repository(tmp_path / "repo", code)
    with pytest.warns(errors.RemoteEnvWarning, match="lerobot is not installed in the jail"):
        suites = make_env(str(folder))
    with suites:
        assert suites.provenance["installed"] is None


@pytest.fixture
def at_home(tmp_path: Path) -> Path:
    """A repository that looks at its home."""
    return write_repository(tmp_path, f"import os\nprint(os.environ['HOME'])\n{STILL}")


@pytest.mark.parametrize("name", ["HOME", "TMPDIR"])
def test_a_granted_home_does_not_break_loading(
    at_home: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The variable has the caller's value; what we write lies in a folder of the jail's own."""
    monkeypatch.setenv(name, "/nowhere/at/all")
    env = make_env(at_home, policy={"environment": (name,)}).env
    env.reset(seed=1)
    env.close()


def test_only_what_a_jail_lacks_is_told(env: Any) -> None:
    """``pty`` says 'out of pty devices'; here there is a number of them, and it is the jail's. What
    has nothing to do with a network or a display gets no advice; a window that cannot be opened is
    no mere abort."""
    env.reset()
    code = "import os, pty\nkept = [os.openpty() for _ in range(64)]\n"
    lacks = r"out of pty devices\. A jail .* at most 64 pseudo"
    with pytest.raises(errors.RemoteEnvError, match=lacks):
        env.call("run", f"{code}pty.fork()")
    env.call("run", "[os.close(fd) for pair in kept for fd in pair]")
    with pytest.raises(errors.RemoteEnvError) as caught:
        env.call("run", "raise ValueError('the display of 3 networks is 97')")
    assert "A jail has no" not in str(caught.value)
    said = 'qt.qpa.plugin: Could not load the Qt platform plugin "xcb" in ""'
    with pytest.raises(errors.WorkerDiedError, match="It tried to open a window") as died:
        env.call("run", f"sys.stderr.write({said!r} + chr(10)); sys.stderr.flush(); os.abort()")
    assert died.value.signal == "SIGABRT"
