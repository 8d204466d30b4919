"""Packages of a repository's own in a jail: where they are found, and by whom."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_sandbox.system.folders import remove_tree
from envhub_sandbox.system.locks import held, sharers
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.runtime import RECORD, Runtime
from envhub_worker.spawn.jail import JailFailed, RunnerExited, RunnerStarted
from envhub_worker.spawn.spawner import RUNNER_TARGET
from envhub_worker.spawn.zygote_process import ZygoteProcess
from tests.support import inside
from tests.support.confinement_kit import (
    Cell,
    make_snapshot,
    new_cell,
    open_folder,
    spawner_in,
)
from tests.support.interpreter import profiles
from tests.support.packages.environments import base_interpreter
from tests.support.trees import fingerprint

MODULE = "mine = 'from the packages'\n"
WHERE = "import mine, sys; result = [mine.mine, sys.path[-1], sys.executable, sys.prefix]"
CHILD = """
import subprocess, sys
code = "import mine, sys; print(mine.mine, sys.prefix)"
result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
"""


@pytest.fixture(params=profiles("strict", "no-userns"))
def confinement(request: pytest.FixtureRequest) -> Confinement:
    """With a private root, and without."""
    return Confinement(profile=request.param)


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that a jail's user may cross."""
    with open_folder() as folder:
        yield folder


@pytest.fixture
def runtime(folder: Path) -> Runtime:
    """One module, and one that has the name of a module of the standard library."""
    packages = folder / "packages"
    packages.mkdir()
    (packages / "mine.py").write_text(MODULE)
    (packages / "colorsys.py").write_text(MODULE)
    (packages / "first.pth").write_text("import sys; sys.started = True\n")
    return Runtime(base_interpreter(), str(packages))


@pytest.fixture
def cell(folder: Path, confinement: Confinement, runtime: Runtime) -> Iterator[Cell]:
    """A jail with these packages."""
    with spawner_in(folder, confinement, runtime=runtime) as spawner:
        cell = new_cell(spawner, make_snapshot(folder), confinement)
        cell.start()
        yield cell


def test_packages_lie_behind_the_standard_library(cell: Cell, runtime: Runtime) -> None:
    """As those of any interpreter; their .pth files count."""
    found, last, *_ = cell.run(WHERE)["result"]
    assert (found, last) == ("from the packages", runtime.packages)
    assert cell.run("import colorsys; result = hasattr(colorsys, 'mine')") == {"result": False}
    assert cell.run("import sys; result = sys.started") == {"result": True}
    assert cell.run("result = callable(exit)") == {"result": True}


def test_packages_of_the_interpreter_are_not_there(cell: Cell) -> None:
    """Neither those of the tests' interpreter, nor what a distribution added to its base."""
    paths = cell.run("import sys; result = sys.path")["result"]
    assert not [path for path in paths if "site-packages" in path or "dist-packages" in path]
    assert cell.run("import gymnasium")["error"] == "ModuleNotFoundError"


def test_programs_that_are_started_have_the_packages_too(cell: Cell) -> None:
    """``sys.executable`` is a virtual environment around them."""
    _, _, executable, prefix = cell.run(WHERE)["result"]
    assert cell.run(CHILD)["result"].split() == ["from", "the", "packages", prefix]
    assert executable.startswith(f"{prefix}/")
    assert cell.start() == 2  # a second runner finds it made
    assert cell.run(CHILD, runner=2)["result"].split()[-1] == prefix


def test_shared_packages_cannot_be_written(cell: Cell, runtime: Runtime) -> None:
    """Whoever needs the same packages shares the folder; the modes shall not be what saves it."""
    os.chmod(runtime.packages, 0o777)
    was = fingerprint(runtime.packages)
    cell.run(f"open({runtime.packages + '/added'!r}, 'w')")
    assert fingerprint(runtime.packages) == was
    (Path(runtime.packages) / "added").write_text("")  # the control
    assert fingerprint(runtime.packages) != was


def test_the_zygote_imports_no_package(
    folder: Path, confinement: Confinement, runtime: Runtime
) -> None:
    """What was started ahead for these packages is used, and has none of the server's either."""
    ahead = ZygoteProcess.ahead(folder, runtime)
    with spawner_in(folder, confinement, runtime=runtime, ahead=ahead) as spawner:
        cell = new_cell(spawner, make_snapshot(folder), confinement)
        cell.start()
        names = cell.run("import sys; result = sorted(sys.modules)")["result"]
        assert inside.zygote_pid(spawner) == ahead.pid
    ours = {name for name in names if name.partition(".")[0] not in sys.stdlib_module_names}
    assert {name.partition(".")[0] for name in ours} <= {"__main__", "__mp_main__", "envhub_worker"}


@pytest.mark.parametrize("what", ["missing", "closed", "closed inside"])
def test_packages_that_cannot_be_read_are_told(
    folder: Path, confinement: Confinement, runtime: Runtime, what: str
) -> None:
    """Before anything runs, with the path and what to do."""
    packages = Path(runtime.packages)
    if what == "missing":
        runtime = Runtime(runtime.python, str(folder / "nowhere"))
    (packages / "mine.py" if what == "closed inside" else packages).chmod(0)
    with spawner_in(folder, confinement, runtime=runtime) as spawner:
        cell = new_cell(spawner, make_snapshot(folder), confinement)
        cell.start()
        failed = cell.wait_for(JailFailed)
        assert not [event for event in cell.events if isinstance(event, RunnerStarted)]
    packages.chmod(0o755)
    assert failed.layer == "packages"
    assert str(runtime.packages) in failed.reason
    assert "chmod -R a+rX" in failed.fix


def test_a_server_keeps_packages_from_being_removed(
    folder: Path, confinement: Confinement, runtime: Runtime
) -> None:
    """From the start of their zygote to its end, whether a jail runs or not."""
    record = folder / RECORD
    record.touch()
    with spawner_in(folder, confinement, runtime=runtime):
        with pytest.raises(TimeoutError), held(record):
            pass
        assert list(sharers(record)) == [os.getpid()]
    with held(record):
        pass


@pytest.mark.parametrize("what", ["packages", "snapshot"])
def test_what_is_removed_all_the_same_is_not_blamed_on_the_kernel(
    folder: Path, runtime: Runtime, what: str
) -> None:
    """The next jail of the zygote says which folder is not there any more."""
    confinement = Confinement(profile="strict")
    with spawner_in(folder, confinement, runtime=runtime) as spawner:
        snapshot = make_snapshot(folder)
        cell = new_cell(spawner, snapshot, confinement)
        cell.start()
        assert cell.run("result = 1") == {"result": 1}
        gone = runtime.packages if what == "packages" else snapshot
        remove_tree(Path(gone))
        late = new_cell(spawner, snapshot, confinement)
        failed = late.wait_for(JailFailed)
    assert gone in failed.reason
    assert "was removed after this server began to use it" in failed.reason
    assert "call make_env again" in failed.fix


def test_what_every_jail_imports_is_named_where_it_is_missing(
    folder: Path, confinement: Confinement, runtime: Runtime
) -> None:
    """The runner ends, and its output says in one line what the folder lacks."""
    with spawner_in(folder, confinement, runtime=runtime, target=RUNNER_TARGET) as spawner:
        cell = new_cell(spawner, make_snapshot(folder), confinement)
        cell.start()
        assert cell.wait_for(RunnerExited).code == 1
        cell.wait_for_output(b"make the environment again with these")
    assert runtime.packages.encode() in cell.output
    assert b"Traceback" not in cell.output
