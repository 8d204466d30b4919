"""Packages that run code by themselves: while they are chosen, installed, or merely lie there.
Each trap leaves a file in a folder that no jail can write to, so that the file says from outside
whether it went off outside of one. The control springs the same trap with the same uv, or in an
interpreter that has the same packages, as one does without this project."""

import contextlib
import shutil
import socket
import subprocess
import tarfile
from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import DependencyError, EnvHubError
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.bounds import measured
from envhub_sandbox.extras.packages.resolution import index as places
from envhub_sandbox.extras.packages.resolution import uv
from envhub_sandbox.sandboxes.process import BOOTSTRAP
from envhub_worker.extras.access.packages import Packages
from envhub_worker.extras.access.quotas import Quotas
from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.records import RefusedError
from tests.remote.listening import listening
from tests.support.packages.wheels import Index, make_wheel
from tests.support.processes import eventually
from tests.support.repositories import write_repository

ENV = """
import sys
import gymnasium as gym
import bait

class Told(gym.Wrapper):
    def sprung(self):
        return sorted(name for name in sys.modules if name.startswith("trap_"))
    def bait(self):
        return bait.VERSION

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda: Told(gym.make("CartPole-v1"))] * n_envs)
"""
BAIT = {"bait/__init__.py": "VERSION = 'swallowed'\n"}


def trap(folder: Path, name: str) -> str:
    """Code that leaves a file, if it can; what it cannot do does not stop it."""
    lines = ("import os", "try:", f"    open({str(folder / name)!r}, 'a').write('sprung')")
    return "\n".join([*lines, "except OSError:", "    pass", ""])


@pytest.fixture
def traces(tmp_path: Path) -> Path:
    """The folder that shows what went off outside; everybody may write there but a jail."""
    folder = tmp_path / "traces"
    folder.mkdir()
    folder.chmod(0o777)
    return folder


def sprung(traces: Path) -> set[str]:
    """What went off, and forgotten again."""
    found = {path.name for path in traces.iterdir()}
    for path in traces.iterdir():
        path.unlink()
    return found


def virtual_environment(folder: Path, wheels: list[Path]) -> Path:
    """An interpreter with these packages among its own: where pip would put them."""
    subprocess.run([interpreters.own().path, "-m", "venv", "--without-pip", folder], check=True)
    [site] = folder.glob("lib/python3*/site-packages")
    for wheel in wheels:
        shutil.unpack_archive(wheel, site, "zip")
    return folder / "bin" / "python"


def what_starts_by_itself(folder: Path, traces: Path) -> Path:
    """A wheel whose files an interpreter runs at its start, and Gymnasium when it looks around."""
    files = {
        "trap_pth.py": trap(traces, "pth"),
        "trap.pth": "import trap_pth\n",
        "sitecustomize.py": trap(traces, "sitecustomize"),
        "usercustomize.py": trap(traces, "usercustomize"),
        "trap_plugin.py": trap(traces, "plugin") + "def register(): pass\n",
        "bait-1.0.dist-info/entry_points.txt": (
            "[gymnasium.envs]\n__root__ = trap_plugin:register\n"
        ),
    }
    return make_wheel(folder, "bait", "1.0", {**BAIT, **files})


def test_what_an_interpreter_starts_with(real_index: Index, tmp_path: Path, traces: Path) -> None:
    """``.pth``, ``sitecustomize``, ``usercustomize``, and plugins that are loaded early: no
    interpreter outside of a jail has them."""
    wheel = what_starts_by_itself(real_index.folder, traces)
    python = virtual_environment(tmp_path / "control", [wheel])
    subprocess.run([str(python), "-c", "pass"], check=True)
    assert "pth" in sprung(traces)
    [site] = (tmp_path / "control").glob("lib/python3*/site-packages")
    subprocess.run([str(python), "-c", "pass"], check=True, env={"PYTHONPATH": str(site)})
    assert "sitecustomize" in sprung(traces)
    load = "from importlib.metadata import entry_points as e\n[x.load() for x in e(group={!r})]"
    subprocess.run([str(python), "-c", load.format("gymnasium.envs")], check=True)
    assert "plugin" in sprung(traces)
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt="bait==1.0\n")
    with make_env(folder) as suites:
        suites.env.reset(seed=0)
        assert suites.env.call("bait") == ("swallowed",)
        assert suites.env.call("sprung") == (["trap_pth"],)  # and there it may
    assert sprung(traces) == set()


@pytest.mark.parametrize(
    ("version", "names"),
    [("3.0", ["numpy"]), ("3.1", ["encodings", "json", "msgpack", "zmq", "envhub_worker"])],
)
def test_a_package_of_a_name_that_we_import(
    real_index: Index, tmp_path: Path, traces: Path, version: str, names: list[str]
) -> None:
    """What it calls so is imported by its own jails at most, and there confined."""
    files = {**BAIT, **{f"{name}/__init__.py": trap(traces, name) for name in names}}
    wheel = make_wheel(real_index.folder, "bait", version, files)
    python = virtual_environment(tmp_path / "control", [wheel])
    [site] = (tmp_path / "control").glob("lib/python3*/site-packages")
    for name in names:
        bare = f"import sys; sys.path.insert(0, {str(site)!r}); sys.modules.pop({name!r}, 0)"
        subprocess.run([str(python), "-c", f"{bare}; import {name}"], check=True)
    assert sprung(traces) == set(names)
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt=f"bait=={version}\n")
    # it may well break its own jail
    with contextlib.suppress(EnvHubError), make_env(folder) as suites:
        suites.env.reset(seed=0)
    assert sprung(traces) == set()


BACKEND = """
{trap}
def build_wheel(*given, **named):
    raise SystemExit("built")
get_requires_for_build_wheel = prepare_metadata_for_build_wheel = build_editable = build_wheel
get_requires_for_build_editable = prepare_metadata_for_build_editable = build_wheel
"""
PROJECT = """
[build-system]
requires = []
build-backend = "backend"
backend-path = ["."]
[project]
name = "trapped"
dynamic = ["version", "dependencies"]
"""


def source(folder: Path, traces: Path) -> Path:
    """A project that springs a trap when it is built, and needs nothing for that."""
    folder.mkdir()
    (folder / "backend.py").write_text(BACKEND.format(trap=trap(traces, "built")))
    (folder / "pyproject.toml").write_text(PROJECT)
    return folder


def plain_uv(given: str, cwd: Path) -> None:
    """Choose versions as one does without this project."""
    python = interpreters.own().path
    command = [uv.command(), "pip", "compile", "-", "--no-config", "--python", python]
    subprocess.run(
        command, input=given, text=True, capture_output=True, cwd=cwd, env=places.environment()
    )


LINES = {
    # an option that installs a folder; uv builds that although it is told to build nothing
    "editable": "-e {source}",
    # a requirement that is a path, in the form of a URL
    "linked": "trapped @ file://{source}",
    # the repository's own folder, by a relative path
    "relative": "./source",
    # an option in a marker's text, which is read with its escapes and was printed without them
    "smuggled": 'numpy; os_name == "x" or os_name == "posix"\n-e {source}\nnumpy; os_name == "x"',
}


def set_trap(kind: str, folder: Path, traces: Path) -> str:
    """The line by which a repository asks for a source; plain uv has built it: the control."""
    text = LINES[kind].format(source=source(folder / "source", traces))
    plain_uv(f"{text}\n", folder)
    assert sprung(traces), "the control builds nothing"
    if kind != "smuggled":
        return text
    inside = text[len('numpy; os_name == "') : -1].replace("\n", r"\n").replace('"', r"\"")
    return f"numpy; os_name == '{inside}'"


@pytest.mark.parametrize("kind", ["of the index", *LINES])
def test_nothing_is_built_here(real_index: Index, tmp_path: Path, traces: Path, kind: str) -> None:
    """A build runs what the package says: an index's source in a jail, and others not at all."""
    if kind == "of the index":
        line, made = "trapped", source(tmp_path / "source", traces)
        with tarfile.open(real_index.folder / "trapped-1.0.tar.gz", "w:gz") as archive:
            archive.add(made, "trapped-1.0")
        plain_uv("trapped\n", tmp_path)
        assert sprung(traces), "the control builds nothing"
    else:
        line = set_trap(kind, tmp_path, traces)
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt=f"{line}\n")
    shutil.copytree(tmp_path / "source", folder / "source")
    with pytest.raises(DependencyError):
        make_env(folder)
    assert sprung(traces) == set()


def test_making_bytecode_runs_nothing(real_index: Index, tmp_path: Path, traces: Path) -> None:
    """Nor does a module that is called as what the compiler imports; nor one in ``tests``."""
    names = ("compileall", "py_compile", "re", "resource", "struct", "concurrent", "tests")
    files = {f"{name}.py": trap(traces, name) for name in names}
    files["bait/tests/conftest.py"] = trap(traces, "conftest")
    wheel = make_wheel(real_index.folder, "bait", "4.0", {**BAIT, **files})
    site = tmp_path / "control"
    shutil.unpack_archive(wheel, site, "zip")
    command = [interpreters.own().path, "-S", "-m", "compileall", "-q", "bait"]
    subprocess.run(command, cwd=site, capture_output=True)
    assert sprung(traces)
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt="bait==4.0\n")
    with make_env(folder) as suites:
        suites.env.reset(seed=0)
    assert sprung(traces) == set()


ESCAPED = """\
import runpy, socket, sys
bootstrap = runpy.run_path(sys.argv[1])
bootstrap["load_package"]()
from envhub_worker.extras import bytecode
if sys.argv[2] == "confined":
    bytecode.confine_to_bytecode_folder(sys.argv[3])
def attempt(work):
    try:
        work()
    except OSError:
        pass
attempt(lambda: open(sys.argv[4] + "/written", "w").close())
attempt(lambda: open(sys.argv[3] + "/copied", "w").write(open(sys.argv[4] + "/secret").read()))
attempt(lambda: socket.socket().connect(("127.0.0.1", int(sys.argv[5]))))
open(sys.argv[3] + "/reached", "w").close()
"""


def escaped(how: str, folder: Path, outside: Path) -> set[str]:
    """What somebody gets who takes the compiler over, judged from outside."""
    folder.mkdir()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        words = [str(BOOTSTRAP), how, str(folder), str(outside), str(listener.getsockname()[1])]
        command = [interpreters.own().path, "-I", "-S", "-c", ESCAPED, *words]
        subprocess.run(command, timeout=300, stderr=subprocess.DEVNULL)
        listener.setblocking(False)
        found = {path.name for path in (folder, outside) for path in path.iterdir()} - {"secret"}
        try:
            listener.accept()[0].close()
        except BlockingIOError:
            return found
        return found | {"heard"}


def test_a_compiler_that_is_taken_over_has_only_the_folder(tmp_path: Path) -> None:
    """What it reads is a stranger's: no other file, no network; the folder is theirs anyway."""
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "secret").write_text("a secret")
    assert escaped("free", tmp_path / "control", outside) == {
        *("written", "copied", "heard", "reached")
    }
    assert (tmp_path / "control/copied").read_text() == "a secret"
    (outside / "written").unlink()
    assert escaped("confined", tmp_path / "folder", outside) == {"copied", "reached"}
    assert (tmp_path / "folder/copied").read_text() == ""


# --- on another host ----------------------------------------------------------------------------


def test_a_server_elsewhere_runs_none_of_it(
    real_index: Index, tmp_path: Path, traces: Path
) -> None:
    """What it installs for a client lies where no interpreter of its own looks."""
    wheel = what_starts_by_itself(real_index.folder, traces)
    python = virtual_environment(tmp_path / "control", [wheel])
    subprocess.run([str(python), "-c", "pass"], check=True)
    assert "pth" in sprung(traces)
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt="bait==1.0\n")
    with (
        listening(tmp_path / "server", "--dependencies") as server,
        make_env(folder, sandbox=server.sandbox()) as suites,
    ):
        suites.env.reset(seed=0)
        assert suites.env.call("sprung") == (["trap_pth"],)  # in the jail it may
    assert sprung(traces) == set()


def ordered(folder: Path, line: str, quota: int = Quotas().packages_bytes) -> str:
    """What a server's packages become for a client that checks nothing: a state, or a reason."""
    packages = Packages(folder, Quotas(packages_bytes=quota))
    request = m.NeedPackages(((line, "line 1"),), "", "", "", True)
    states: list[str] = []

    def settled() -> bool:
        try:
            states.append(packages.need(b"key", request, ()).state)
        except RefusedError as error:
            states.append(error.missing)
        return states[-1] != "making"

    try:
        assert eventually(settled)
    finally:
        packages.close()
    return states[-1]


@pytest.mark.parametrize("kind", LINES)
def test_a_client_that_checks_nothing_has_nothing_built(
    real_index: Index, tmp_path: Path, traces: Path, kind: str
) -> None:
    """The server reads an order as a stranger's file, whatever its client has made of it."""
    line = set_trap(kind, tmp_path, traces)
    assert ordered(tmp_path / "packages", line) == "requirement"
    assert sprung(traces) == set()


def test_a_client_does_not_fill_the_servers_disk(index: Index, tmp_path: Path) -> None:
    """One key has one quota for all of it, and nothing stays of what went over it."""
    big = {"bulky/__init__.py": "", **{f"bulky/{n}.bin": bytes(2 << 20) for n in range(8)}}
    make_wheel(index.folder, "bulky", "1.0", big)
    roomy, tight = tmp_path / "roomy", tmp_path / "tight"
    assert ordered(roomy, "bulky==1.0") == "made"  # the control: it is as large as that
    assert measured(roomy)[0] > 16 << 20
    assert ordered(tight, "bulky==1.0", quota=8 << 20) == "size"
    assert measured(tight)[0] < 1 << 20
    assert not list(tight.glob("*/environments/*/packages"))
