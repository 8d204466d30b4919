"""Doing something through the client's terminal: typing into it, writing to it, escape codes."""

import contextlib
import json
import os
import pty
import select
import signal
import sys
import time
import traceback
from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError, WorkerDiedError
from tests.attacks.harness import HOSTILE, USER, Arena, token
from tests.attacks.output.painting import ESCAPES, paints
from tests.attacks.repositories import write_environment

FAMILY = "The terminal"
_CLIENT = """
import json, os, sys
sys.path.insert(0, sys.argv[2])
place, folder, payload, arguments, profile = json.loads(sys.argv[1])
arguments["ways"] = ["/dev/tty", os.ttyname(0)]
if payload == "type_into_terminal":
    del arguments["ways"]
if place == "control":
    sys.path.insert(0, folder)
    from payloads.running import attack_of
    print(attack_of(payload)(**arguments))
else:
    from envhub_sandbox import make_env
    with make_env(folder, policy={"profile": profile}) as suites:
        [answer] = suites.env.call("attack", payload, arguments, "atk-terminal")
    print("answer" if answer in ("typed", "written") else "refused")
print("the end", flush=True)
"""


@pytest.mark.parametrize(
    ("title", "payload"),
    [
        ("type into the terminal (TIOCSTI)", "type_into_terminal"),
        ("write to the terminal", "write_to_terminal"),
    ],
)
def test_terminal_is_out_of_reach(arena: Arena, title: str, payload: str) -> None:
    needs_root = payload == "type_into_terminal" and not legacy_tiocsti()
    impossible = "dev.tty.legacy_tiocsti is 0" if needs_root and USER != "root" else ""
    text = token()
    control = in_terminal(arena, "control", payload, text)
    if not impossible:
        assert text in control, control
    text = token()
    shown = in_terminal(arena, "inside", payload, text)
    assert "the end" in shown, shown
    state = "not possible" if impossible else "succeeds"
    arena.judge(title, state, text in shown, shown, impossible)


def legacy_tiocsti() -> bool:
    """Whether a plain user may type into its own terminal on this host."""
    path = Path("/proc/sys/dev/tty/legacy_tiocsti")
    return not path.exists() or path.read_text().strip() == "1"


def in_terminal(arena: Arena, place: str, payload: str, text: str) -> str:
    words = json.dumps([place, str(HOSTILE), payload, {"text": text}, arena.profile])
    root = str(Path(__file__).parents[3])
    pid, screen = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, "-c", _CLIENT, words, root])
    shown = b""
    deadline = time.monotonic() + 200  # a client has all of its imports to do
    try:
        while b"the end" not in shown and time.monotonic() < deadline:
            if select.select([screen], [], [], 0.2)[0]:
                shown += os.read(screen, 65536)
        if select.select([screen], [], [], 0.2)[0]:
            shown += os.read(screen, 65536)
    except OSError:
        pass  # the terminal has closed: all has been shown
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(screen)
    return shown.decode("utf-8", "replace")


_ENV = f"""
import os, sys

EVIL = {ESCAPES!r}
Evil = type("Evil" + EVIL, (Exception,), {{}})

class Painter(Plain):
    metadata = {{"render_modes": [], "note": EVIL}}

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {{EVIL: EVIL}}

    def step(self, action):
        print(EVIL, flush=True)
        sys.stderr.write(EVIL)
        if action == 0:
            raise Evil(EVIL)
        os._exit(3)

    @property
    def painted(self):
        return type("Thing", (), {{"__repr__": lambda self: EVIL}})()
"""


@pytest.mark.short("strict")
def test_errors_do_not_paint(arena: Arena, home: Path) -> None:
    """Class names, messages, tracebacks and output arrive with their control characters spelt."""
    folder = write_environment(home / "painter", _ENV)
    with make_env(str(folder), policy={"profile": arena.profile}) as suites:
        env = suites.env
        env.reset()
        shown = [str(env.call("painted")), repr(env), repr(suites), str(suites)]
        for action in (0, 1):
            with pytest.raises(EnvHubError) as caught:
                env.step([action])
            error = caught.value
            shown += [str(error), repr(error), "".join(traceback.format_exception(error))]
            shown += [str(vars(error)), *map(str, vars(error).values())]
        assert isinstance(error, WorkerDiedError)
        assert "owned" in error.log_tail
        shown.append(repr(suites.provenance))
    painted = [text for text in shown if paints(text)]
    arena.judge("escape sequences in errors and output", "succeeds", bool(painted), str(painted))


def test_the_control_paints() -> None:
    """The control of the escapes: printed as they are, they would be obeyed."""
    assert paints(ESCAPES)
    assert paints(str(Exception(ESCAPES)))


@pytest.mark.parametrize("where", ["suite", "task"])
def test_names_do_not_paint(arena: Arena, home: Path, where: str) -> None:
    """Names of suites and tasks, which are printed all the time, cannot hold control characters."""
    result = {"suite": "{EVIL: {0: env}}", "task": "{'suite': {EVIL: env}}"}[where]
    text = f"{_ENV}def make_env(n_envs=1, use_async_envs=False):\n"
    text += f"    env = gym.vector.SyncVectorEnv([Painter])\n    return {result}\n"
    folder = write_environment(home / "painter", text)
    try:
        with make_env(str(folder), policy={"profile": arena.profile}) as suites:
            names = [*suites, *(str(task) for suite in suites.values() for task in suite)]
    except EnvHubError as error:
        names = ["".join(traceback.format_exception(error))]
    painted = [name for name in names if paints(name)]
    arena.judge(f"escape sequences in the name of a {where}", "succeeds", bool(painted), str(names))
