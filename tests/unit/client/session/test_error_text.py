"""What is added to an error: the author's own line, what a jail lacks, and what it was denied."""

import ast
import copy
import pickle
import re
from pathlib import Path

import gymnasium
import pytest

from envhub_sandbox import errors
from envhub_sandbox.errors import EnvHubError, RemoteEnvError, WorkerDiedError
from envhub_sandbox.hub.listing import FileRecord, Snapshot
from envhub_sandbox.session.error_text import add_author_line, add_reach_advice, read_denials
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.transport.replies import raised
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.text import MARGIN
from envhub_worker.runner.described import raised as described

ROOT = "/store/tree"
FILES = tuple(FileRecord(path, 1, "sha256:0") for path in ("env.py", "lib/a.py", "lib/b.py"))
LOCAL = Snapshot("/home/me/my-env", "local", "local-1", "env.py", Path(ROOT), FILES)
HUB = Snapshot("org/repo", "space", "0123456789ab" + "0" * 28, "env.py", Path(ROOT), FILES)
TRACE = """Traceback (most recent call last):
  File "env.py", line 12, in step
    helper(0)
  File "lib/a.py", line 2, in helper
    return np.linalg.inv(x)
           ~~~~~~~~~~~~~^~~
  File "/usr/lib/python3/numpy/linalg.py", line 561, in inv
    raise LinAlgError("no")
ValueError: no
"""


def failed(traceback: str, snapshot: Snapshot = LOCAL, stage: str = "step") -> EnvHubError:
    error = raised(m.RaisedException("ValueError", "ValueError", "no", traceback, stage))
    add_author_line(error, snapshot)
    return error


def notes(error: EnvHubError) -> str:
    return "\n".join(vars(error).get("__notes__", ())).replace(f"\n{MARGIN}", "\n")


@pytest.mark.parametrize(
    ("snapshot", "place"),
    [(LOCAL, '"/home/me/my-env/{}"'), (HUB, '"{}" of spaces/org/repo@0123456789ab')],
)
@pytest.mark.parametrize("stage", ["step", "make_env"])
def test_the_authors_last_line_is_in_the_text(snapshot: Snapshot, place: str, stage: str) -> None:
    error = failed(TRACE, snapshot, stage)
    last = f"  File {place.format('lib/a.py')}, line 2, in helper\n    return np.linalg.inv(x)"
    assert str(error).endswith(f"ValueError: no\n{last}")
    assert f"File {place.format('env.py')}, line 12, in step\n    helper(0)\n" in notes(error)
    assert 'File "/usr/lib/python3/numpy/linalg.py", line 561' in notes(error)
    remote = error if stage == "step" else error.__cause__
    assert isinstance(remote, errors.RemoteEnvError)
    assert (remote.where, remote.file, remote.line) == (last, "lib/a.py", 2)
    assert remote.traceback.rstrip() in notes(error)
    before = str(error), notes(error)
    add_author_line(error, snapshot)
    assert (str(error), notes(error)) == before, "it is told once"


def test_a_path_in_the_store_is_taken_for_the_authors_too() -> None:
    error = failed(TRACE.replace('"env.py"', f'"{ROOT}/env.py"').replace('"lib/a.py"', '"x.py"'))
    assert str(error).endswith('  File "/home/me/my-env/env.py", line 12, in step\n    helper(0)')
    assert ROOT not in notes(error)


@pytest.mark.parametrize(
    "name", ["train.py", "../env.py", "lib", "lib/", "", "env.pyc", "/home/me/my-env/env.py", "env"]
)
def test_only_files_of_the_snapshot_are_pointed_at(name: str) -> None:
    """A worker fills in which of them; it cannot send the reader anywhere else."""
    error = failed(f'Traceback:\n  File "{name}", line 3, in x\n    y\nValueError: no\n')
    assert str(error) == "ValueError: no"
    assert isinstance(error, RemoteEnvError)
    assert (error.file, error.line) == ("", 0)


@pytest.mark.parametrize(
    ("margin", "source", "caret", "shown"),
    [
        ("    ", "x = (1 +", "    ^^^^", "    x = (1 +\n        ^^^^"),
        ("    ", "\tx =\t(", "\t   \t^", "    x = (\n        ^"),
        ("  |     ", "x = (", "    ^", "    x = (\n        ^"),
        ("    ", "x" * 300, " " * 290 + "^", "    " + "x" * 200 + "..."),
        ("    ", "x = (", " " * 9000 + "^", "    x = ("),
    ],
    ids=["plain", "tabs", "of a group", "long line", "far"],
)
def test_a_syntax_error_has_its_caret(margin: str, source: str, caret: str, shown: str) -> None:
    lines = ("Traceback:", '  File "env.py", line 1', margin + source, margin + caret, "no")
    error = failed("\n".join(lines), stage="import")
    assert str(error).endswith(f'  File "/home/me/my-env/env.py", line 1\n{shown}')


def test_copies_and_pickles_keep_the_line() -> None:
    for stage in ("step", "make_env"):
        error = failed(TRACE, stage=stage)
        for made in (copy.copy(error), pickle.loads(pickle.dumps(error))):
            assert (str(made), notes(made)) == (str(error), notes(error))


HOSTILE = "\x1b]0;owned\x07\x1b[2J\r\u202e"


@pytest.mark.parametrize(
    "trace",
    [
        f'  File "env.py", line 1, in {HOSTILE}\n    {HOSTILE}\n',
        f'  File "{HOSTILE}env.py", line 1, in x\n    y\n',
        '  File "env.py", line 1, in ' + "x" * 100_000,
        '  File "env.py", line 1, in x\n    ' + "y" * 100_000,
        '  File "env.py", line 1, in x\n    y\n' * 20_000,
        '  File "' + "e" * 100_000 + '", line 1\n',
        '  File "env.py", line ' + "9" * 10_000 + "\n",
        "  " * 50_000 + 'File "env.py", line 1\n',
        "| + - " * 20_000,
    ],
    ids=range(9),
)
@pytest.mark.parametrize("stage", ["step", "import"])
def test_hostile_tracebacks_stay_bounded_and_printable(trace: str, stage: str) -> None:
    folder = Snapshot(f"/home/{HOSTILE}", "local", "local-1", "env.py", Path(ROOT), FILES)
    error = failed(trace, stage=stage)
    for text in (str(error), notes(error)):
        assert all(char in "\n\t" or char.isprintable() for char in text)
        assert len(text) < 40_000
    assert len(str(error)) < 2_000
    in_it = failed(TRACE, folder)
    assert "\\x1b" in str(in_it), "a folder may have any name"
    assert all(char in "\n\t" or char.isprintable() for char in str(in_it) + notes(in_it))


# --- in the worker --------------------------------------------------------------------------


def a_failure(folder: Path, source: str) -> m.RaisedException:
    path = folder / "env.py"
    path.write_text(source)
    try:
        exec(compile(source, str(path), "exec"), {"__name__": "hub_env.env"})
    except Exception as error:
        return described(error, "step", str(folder))
    raise AssertionError("nothing was raised")


def test_files_of_the_repository_have_their_names_in_it(tmp_path: Path) -> None:
    """Causes included; the line of the source is found all the same."""
    source = "try:\n    1 / 0\nexcept ArithmeticError as error:\n    raise KeyError from error\n"
    failure = a_failure(tmp_path, source)
    assert failure.traceback.count('File "env.py", line') == 2
    assert "    1 / 0\n" in failure.traceback
    assert str(tmp_path) not in failure.traceback
    failure = a_failure(tmp_path, "def make_env(:\n")  # which has no frame in the repository
    assert '  File "env.py", line 1\n    def make_env(:\n                 ^\n' in failure.traceback


def advised(kind: str, message: str, network: str = "none") -> str:
    error = RemoteEnvError(kind, message)
    before = str(error)
    is_explained = add_reach_advice(error, Policy(network=network))
    add_reach_advice(error, Policy(network=network))  # once
    assert is_explained == (str(error) != before)  # then no packages of another day are named
    return str(error).removeprefix(before)


@pytest.mark.parametrize(
    ("kind", "message", "named"),
    [
        ("huggingface_hub.errors.LocalEntryNotFoundError", "outgoing traffic ...", "assets="),
        ("OSError", "We couldn't connect to 'https://huggingface.co' to load", "assets="),
        ("subprocess.CalledProcessError", "Command '['uv', 'pip', 'install', 'x']' ...", "['x']"),
        (
            "gymnasium.error.DependencyNotInstalled",
            'pygame is not installed, run `pip install "gymnasium[classic-control]"`',
            "{'extra': ['gymnasium[classic-control]']}",
        ),
        ("ImportError", "run `pip3 install -U a b[c]>=2` now", "{'extra': ['a', 'b[c]>=2']}"),
        ("ImportError", "pip install git+https://x/y", "{'extra': ['PACKAGE']}"),
        ("ImportError", "`pip install " + "a==1 " * 64, "{'extra': ['a==1']}"),  # not in 2**64 ways
        ("EOFError", "EOF when reading a line", "policy={'environment': ['NAME']}"),
        (
            "ImportError",
            "Please declare the environment variable 'SIM_HOME'",
            "policy={'environment': ['SIM_HOME']}",
        ),
        ("ImportError", "('Unable to load OpenGL library', 'OSMesa: cannot open')", "libosmesa6"),
        ("AttributeError", "'NoneType' object has no attribute 'glGetError'", "libosmesa6"),
        ("OSError", "[Errno 97] Address family not supported by protocol", "'loopback'"),
        ("subprocess.CalledProcessError", "Command '['git', '-C', 'x', 'pull']' ...", "assets="),
        ("socket.gaierror", "[Errno -3] Temporary failure in name resolution", "assets="),
        ("pyglet.display.xlib.NoSuchDisplayException", 'Cannot connect to "None"', "window"),
        ("_tkinter.TclError", "no display name and no $DISPLAY environment variable", "window"),
        ("glfw.GLFWError", "(65550) b'X11: Failed to open display '", "window"),
        ("pygame.error", "No available video device", "window"),
        (
            "FileNotFoundError",
            "[Errno 2] No such file or directory: '/x/packages/gym_x/a.json'",
            "An installed package lacks this file",
        ),
        (
            "FileNotFoundError",
            "[Errno 2] No such file or directory: 'data/a.mat'",
            "in the repository",
        ),
        (
            "FileNotFoundError",
            "[Errno 2] No such file or directory: 'data/packages/a.csv'",
            "in the repository",
        ),
    ],
)
def test_each_failure_names_what_brings_it(kind: str, message: str, named: str) -> None:
    advice = advised(kind, message)
    assert named in advice
    assert advice.count("\n") == 1
    for fields in re.findall(r"policy=(\{.*\})", advice):
        Policy(**ast.literal_eval(fields))  # accepts what is advised


@pytest.mark.parametrize(
    ("creator", "named"),
    [("make", "env_kwargs={'df': 'VALUE', 'window': 'VALUE'}"), ("lambda: make()", "")],
    ids=["itself", "a function below, of a package that may have changed"],
)
def test_arguments_that_an_environment_lacks_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, creator: str, named: str
) -> None:
    monkeypatch.setattr(gymnasium.envs.registration, "registry", {})
    source = (
        "import gymnasium\ndef make(df, window):\n    pass\n"
        f"gymnasium.register('Lacking-v0', {creator})\ngymnasium.make('Lacking-v0')\n"
    )
    failure = a_failure(tmp_path, source)
    error = raised(failure)
    assert add_reach_advice(error, Policy()) == bool(named)
    assert named in str(error)


@pytest.mark.parametrize(
    ("kind", "message", "network"),
    [
        ("ValueError", "pip and git are words, a display too", "none"),
        ("KeyError", "'connect'", "none"),
        ("KeyError", "please set the environment variable HF_TOKEN", "none"),
        ("FileNotFoundError", "[Errno 2] No such file or directory: 'ffmpeg'", "none"),
        ("socket.gaierror", "[Errno -3] Temporary failure in name resolution", "host"),
        ("ConnectionRefusedError", "[Errno 111] Connection refused", "loopback"),
    ],
)
def test_others_get_none(kind: str, message: str, network: str) -> None:
    """Words alone say nothing, nor does a failure of a network that it has."""
    assert advised(kind, message, network) == ""
    of_another_family = advised("OSError", "[Errno 97] Address family", "loopback")
    assert "loopback" not in of_another_family, "which it has"


def test_of_a_death_only_the_display_is_read() -> None:
    said = "qt.qpa.xcb: could not connect to display \nThis application failed to start"
    for signal, added in (("SIGABRT", True), ("SIGKILL", False)):
        error = WorkerDiedError("died", signal=signal, reason="signal", log_tail=said)
        add_reach_advice(error, Policy())
        assert ("a jail has no display" in str(error)) is added


def test_a_denial_that_is_no_attempt_is_left_out() -> None:
    """Only forms that there are; nothing that a terminal would obey, nothing long, and not many."""
    good = ("ptrace", "socket AF_INET", "write /home/other/x\\x1b")
    bad = (b"ptrace", 7, None, ("ptrace",), "Ptrace", "read x", "read /\x1b[2J", "a" * 41)
    assert read_denials((*bad, *good, "read /" + "x" * 401)) == good
    assert len(read_denials(("ptrace",) * 100_000) or ()) == 128
    for no_list in (None, "ptrace", ["ptrace"], {"ptrace": 1}, 7):
        assert read_denials(no_list) is None
