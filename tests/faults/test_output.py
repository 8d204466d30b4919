"""What a worker prints reaches a file or a log, whatever becomes of the worker."""

import logging
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import errors, make_env
from tests.support import inside
from tests.support.processes import eventually, halted
from tests.support.repositories import write_repository
from tests.support.samples import sample
from tests.support.started import started

pytestmark = pytest.mark.usefixtures("neighbour")


def made(path: Path | None, fault: str, moment: str = "step", **policy: Any) -> Any:
    """An environment that prints, and then does something."""
    if path is not None:
        policy["output"] = str(path)
    kwargs = {"moment": moment, "fault": fault}
    return make_env(sample("faulty"), n_envs=2, env_kwargs=kwargs, policy=policy)


def followers() -> list[threading.Thread]:
    """Threads of ours that follow an output."""
    return [thread for thread in threading.enumerate() if thread.name == "envhub-output"]


def test_the_last_words_are_in_the_file(tmp_path: Path) -> None:
    """Those of a death too, and those of a jail that was ended because it did not answer; a jail
    that follows has a file of its own."""
    died, late = errors.WorkerDiedError, errors.WorkerTimeoutError
    for fault, error, timeout_s in (("exit", died, 60.0), ("hang", late, 1.0)):
        folder = tmp_path / fault
        folder.mkdir()
        path = folder / "w.log"
        with made(path, fault, restart="on_reset", restart_backoff_s=0) as suites:
            for jail in (path, folder / "w-2.log"):
                suites.env.reset()
                suites.env.step_async([0, 1])
                assert eventually(lambda: jail.exists() and "about to" in jail.read_text())  # noqa: B023
                with pytest.raises(error):
                    suites.env.step_wait(timeout=timeout_s)
        texts = {one.name: one.read_text() for one in folder.iterdir()}
        assert texts == dict.fromkeys(("w.log", "w-2.log"), f"about to {fault}\n")
    assert followers() == []


@pytest.mark.parametrize("how", ["close", "exit", "kill", "segfault"])
def test_a_plain_print_is_not_lost_in_a_buffer(tmp_path: Path, how: str) -> None:
    """Nobody writes ``flush=True``; what came before a death is in the error, too."""
    path = tmp_path / "worker.log"
    repository = write_repository(tmp_path / "repository", _CHATTY)
    with started(
        str(repository), env_kwargs={"how": how}, policy={"output": str(path)}, seed=None
    ) as env:
        env.step([0])
        if how != "close":
            with pytest.raises(errors.WorkerDiedError, match="step 2") as caught:
                env.step([1])
            assert "step 1" in caught.value.log_tail
    last = "closed" if how == "close" else "step 2"
    assert path.read_text().splitlines()[:3] == ["reset", "step 1", last]


_CHATTY = """
import ctypes, os, signal
import gymnasium as gym

class Chatty(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)

    def __init__(self, how):
        self.how = how

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        print("reset")
        return 0, {}

    def step(self, action):
        self.steps += 1
        print("step", self.steps)
        if action and self.how == "exit":
            os._exit(3)
        if action and self.how == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if action:
            ctypes.string_at(0)
        return 0, 0.0, False, False, {}

    def close(self):
        print("closed")

def make_env(n_envs=1, use_async_envs=False, how=""):
    return gym.vector.SyncVectorEnv([lambda: Chatty(how)] * n_envs)
"""


def test_a_server_that_says_nothing_for_a_while_is_asked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one of a machine that stands still: what comes later is in the file all the same."""
    monkeypatch.setattr(*inside.WAIT_FOR_OUTPUT, 0.1)
    path = tmp_path / "worker.log"
    with made(path, "hang") as suites:
        suites.env.reset()
        with halted([inside.server(suites.env).process.pid]):
            time.sleep(1.5)  # it is asked a few times a second
        suites.env.step_async([0, 1])
        assert eventually(lambda: "about to hang" in path.read_text())
        with pytest.raises(errors.WorkerTimeoutError):
            suites.env.step_wait(timeout=0.1)
    assert eventually(lambda: followers() == [])  # a close waits for it as long as it asks


def test_output_of_loading_and_closing_is_there(tmp_path: Path) -> None:
    with pytest.raises(errors.LoadError):
        made(tmp_path / "make.log", "raise", "make")
    assert "about to raise" in (tmp_path / "make.log").read_text()
    with made(tmp_path / "close.log", "raise", "close") as suites:
        suites.env.reset()
    assert "about to raise" in (tmp_path / "close.log").read_text()
    assert followers() == []


def test_a_flood_is_bounded_and_said(tmp_path: Path) -> None:
    path = tmp_path / "w.log"
    with made(path, "flood") as suites:
        suites.env.reset()
        suites.env.step([0, 1])
        assert eventually(lambda: "bytes are lost: it printed too fast]" in path.read_text())
    text = path.read_text()
    assert "y\\x1b[31m" in text
    assert "\x1b" not in text


def test_a_file_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    """Before anything runs, whether it is ``make_env`` or the first reset that would run it."""
    with made(None, "exit"):
        pass  # its manifest is known from here on
    nowhere = tmp_path / "nowhere" / "w.log"
    with made(nowhere, "exit") as suites:
        with pytest.raises(errors.PolicyError, match="output"):
            suites.env.reset()
        assert suites.env.sandbox.report() == []
    with pytest.raises(errors.PolicyError, match="output"):
        made(nowhere, "never met before")
    assert followers() == []


def test_the_log_tells_the_life_of_a_jail(caplog: pytest.LogCaptureFixture) -> None:
    """Late, given up and died at INFO; what is ordinary, and what it prints, at DEBUG."""
    caplog.set_level(logging.DEBUG, "envhub_sandbox")
    with made(None, "exit") as suites:
        suites.env.reset()
        with pytest.raises(errors.WorkerDiedError):
            suites.env.step([0, 1])
    with made(None, "hang") as suites:
        suites.env.reset()
        suites.env.step_async([0, 1])
        assert eventually(lambda: "about to hang" in caplog.text)
        with pytest.raises(errors.WorkerTimeoutError):
            suites.env.step_wait(timeout=0.3)
        suites.env.reset()
    told = [(one.name, one.levelname, one.getMessage()) for one in caplog.records]
    for name, level, text in (
        ("envhub_sandbox.worker", "DEBUG", "opened"),
        ("envhub_sandbox.worker", "INFO", "died during step: it exited (exit code 7)"),
        ("envhub_sandbox.crashes", "INFO", "crash bundle"),
        ("envhub_sandbox.worker", "INFO", "no answer to step after 0.3 s"),
        ("envhub_sandbox.worker", "INFO", "given up for a fresh one"),
        ("envhub_sandbox.worker", "DEBUG", "closes"),
        ("envhub_sandbox.worker.output", "DEBUG", "about to exit"),
        ("envhub_sandbox.worker.output", "DEBUG", "about to hang"),
    ):
        assert any(one[:2] == (name, level) and text in one[2] for one in told), text


def test_an_ordinary_life_clutters_nobodys_log(caplog: pytest.LogCaptureFixture) -> None:
    """A host program that shows INFO is told what the code sees, and of nothing else; nor does a
    thread follow what nobody wants."""
    caplog.set_level(logging.INFO)
    with made(None, "never") as suites:
        suites.env.reset()
        assert followers() == []
    [line] = [one.getMessage() for one in caplog.records if one.name.startswith("envhub")]
    assert line.endswith("the code sees 1 file of it")


@pytest.mark.parametrize("output", ["stderr", "-"])
def test_prints_reach_stderr(output: str, capfd: pytest.CaptureFixture[str]) -> None:
    """From Python, without a log or a file; from the import of the entry file to the end."""
    with made(None, "exit", output=output) as suites:
        suites.env.reset()
        with pytest.raises(errors.WorkerDiedError):
            suites.env.step([0, 1])
    assert capfd.readouterr() == ("", "about to exit\n")
    assert not Path(output).exists()
