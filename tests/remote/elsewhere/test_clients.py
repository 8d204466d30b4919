"""A client without Linux: what it does with a server on another host, and what it says."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from envhub_sandbox.cli.shared.exits import Exit
from tests.remote.listening import Listening, counting
from tests.support.elsewhere.kit import SYSTEMS, command, elsewhere, ran
from tests.support.processes import eventually
from tests.support.repositories import STILL, write_repository
from tests.support.samples import sample

pytestmark = pytest.mark.parametrize("system", SYSTEMS)

# the compliance suite and everything else that a client of such a server is asked
_SUITES = {
    "darwin": ("tests/remote/test_parity.py", "-k", "TestCounter"),
    "win32": ("tests/remote/test_parity.py", "tests/remote/test_assets.py"),
}
_QUIET = ("-p", "no:cacheprovider", "--capture=no", "-q", "-n", "0")
_CONNECT = """
import os, sys
from envhub_sandbox import RemoteSandbox, make_env
sandbox = RemoteSandbox(sys.argv[1], server_key=sys.argv[2], client_key=sys.argv[3])
"""
_LIFE = f"""{_CONNECT}
import numpy as np
with make_env(sys.argv[4], n_envs=2, sandbox=sandbox, policy={{"restart": "on_reset"}}) as suites:
    env = suites.env
    env.reset(seed=1)
    assert env.call("number") == (0, 0), env.call("number")
    assert env.step(np.array([0, 0]))[1].tolist() == [1.0, 1.0]
    env.set_attr("offset", 5)
    assert env.call("number") == (6, 6)
    try:
        env.step(np.array([9, 0]))
    except Exception as error:
        print(type(error).__name__)
    env.reset(seed=1)
    assert env.step(np.array([0, 0]))[1].tolist() == [1.0, 1.0]
env.close()
print(sys.platform)
"""
_DIES = """
import os

class Dies(Still):
    observation_space = action_space = gym.spaces.Discrete(10)
    offset = count = 0
    def number(self):
        return self.count + self.offset
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return 0, {}
    def step(self, action):
        if action == 9:
            os._exit(3)
        self.count += 1
        return 0, float(self.count), False, False, {}
"""
_INTERRUPTED = f"""{_CONNECT}
import numpy as np, time
with make_env(sys.argv[4], n_envs=20, sandbox=sandbox) as suites:
    env = suites.env
    env.reset()
    begun = time.monotonic()
    try:
        print("steps", flush=True)
        env.step(np.full(20, 99))
    except KeyboardInterrupt:
        print("interrupted", time.monotonic() - begun < 100, flush=True)
    env.reset()
    print(env.step(np.zeros(20, int))[0][0].tolist())
"""


def words(server: Listening) -> tuple[str, str, str]:
    return server.endpoint, server.public, server.client_key


def variables(server: Listening) -> dict[str, str]:
    return {"ENVHUB_SERVER_KEY": server.public, "ENVHUB_CLIENT_KEY": server.client_key}


def test_the_tests_of_clients_pass(system: str) -> None:
    """The same steps, bit for bit, and all else that they ask, by a client without Linux."""
    done = ran(system, "-m", "pytest", *_QUIET, *_SUITES[system], code=None)
    assert done.returncode == 0, done.stdout[-6000:]
    assert " passed" in done.stdout


def test_it_lives_dies_and_starts_again(system: str, server: Listening, tmp_path: Path) -> None:
    """Reset, step, call, set_attr, a death, a restart, and two closes. It leaves only its cache,
    which lies where that system has it; in the temporary folder nothing is left."""
    home, temporary = tmp_path / "home", tmp_path / "temporary"
    temporary.mkdir()
    folders = {"HOME": str(home), "TMPDIR": str(temporary), "ENVHUB_CACHE": ""}
    repository = write_repository(tmp_path / "repo", STILL + _DIES)
    said = elsewhere(system, _LIFE, *words(server), repository, **folders)
    assert said.split() == ["WorkerDiedError", system]
    assert not list(temporary.iterdir())
    cache = {"darwin": "Library/Caches/envhub-sandbox", "win32": "AppData/Local/envhub-sandbox"}
    assert {path.name for path in (home / cache[system]).rglob("env.py")} == {"env.py"}


def test_ctrl_c_interrupts_a_step(system: str, server: Listening, tmp_path: Path) -> None:
    """Long before the step's end; the environment goes on after a reset."""
    repository = counting(tmp_path / "repo")
    process = subprocess.Popen(
        command(system, "-c", _INTERRUPTED, *words(server), repository),
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        assert process.stdout.readline() == "steps\n"
        time.sleep(0.5)  # so that it waits; sooner is an interrupt, too
        process.send_signal(signal.SIGINT)
        said = process.stdout.read()
    assert (said, process.returncode) == ("interrupted True\n[1.0]\n", 0)


def test_ctrl_c_ends_a_command(system: str, server: Listening, tmp_path: Path) -> None:
    """With the code of one that was interrupted; the server has nothing of it left."""
    repository = counting(tmp_path / "repo")
    run = ("run", repository, "--sandbox", server.endpoint, "--verbose")
    process = subprocess.Popen(
        command(system, *_ENVHUB, *run),
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **variables(server)},
    )
    with process:
        while "opened" not in process.stderr.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        process.stderr.read()
    assert process.returncode == Exit.INTERRUPTED
    assert eventually(lambda: not server.jails())


_COMMANDS = """
import json, sys
from envhub_sandbox.cli import main
code, several = int(sys.argv[1]), json.loads(sys.argv[2])
for sys.argv[1:] in several:
    try:
        main()
    except SystemExit as ended:
        assert (ended.code or 0) == code, (sys.argv, ended.code)
"""


def commands(
    system: str, *several: tuple[str | Path, ...], code: int = 0, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run commands that end with this code one after the other, in one process: each import takes
    seconds."""
    words = json.dumps([[str(word) for word in one] for one in several])
    return ran(system, "-c", _COMMANDS, str(code), words, **variables)


def test_commands_work(system: str, server: Listening, tmp_path: Path) -> None:
    """``run``, ``inspect``, ``check`` with its reports, ``doctor`` of a server, and ``cache``."""
    with_keys = variables(server) | {"ENVHUB_CACHE": str(tmp_path / "cache")}
    where = ("--sandbox", server.endpoint)
    reports = ("--html", tmp_path / "page.html", "--junit", tmp_path / "junit.xml")
    helped = ("", "run", "check", "doctor", "cache list", "image build")
    done = commands(
        system,
        *((*words.split(), "--help") for words in helped),
        ("run", sample("cartpole"), "--episodes", "1", *where),
        ("inspect", sample("cartpole"), *where),
        ("check", sample("cartpole"), *where, *reports),
        ("doctor", server.endpoint),
        ("cache", "list"),
        ("cache", "remove", "--all"),
        **with_keys,
    )
    assert done.stdout.count("Usage:") == len(helped)
    for text in ("confined by  strict", "Discrete(2)", "it knows our key"):
        assert text in done.stdout
    for text in ("passed", "\n1 snapshot", "Removed 1 snapshot"):
        assert text in done.stderr
    assert (tmp_path / "page.html").read_text("utf-8").startswith("<!doctype html>")
    assert not list((tmp_path / "cache").rglob("env.py"))


_ENVHUB = ("-m", "envhub_sandbox")


def test_the_default_says_what_there_is_instead(system: str, tmp_path: Path) -> None:
    """Before anything is downloaded; both other ways are named, by a command's options, too. No
    engine answers here: ``doctor`` says so, and how to get one that runs on such a system."""
    name = {"darwin": "macOS", "win32": "Windows"}[system]
    asked = ("run", "nobody/nothing"), ("lock", sample("cartpole")), ("doctor",)
    nowhere = {"PATH": str(tmp_path), "DOCKER_HOST": ""}
    done = commands(system, *asked, code=Exit.SANDBOX, **nowhere)
    for text in (f"this is {name}", "--sandbox docker", "--sandbox tcp://HOST:PORT"):
        assert text in done.stderr
    assert "run this on a Linux machine" in done.stderr
    assert "there is no --sandbox process" in done.stdout
    assert "there is no docker on PATH; install Docker Desktop" in done.stdout
    assert "envhub doctor tcp://HOST:PORT" in done.stdout
