"""Packages of a repository's own in a jail: where they are found, and by whom."""

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
from tests.support.confinement_kit import Cell, make_snapshot, new_cell, open_folder, spawner_in
from tests.support.interpreter import needs, profiles
from tests.support.packages.environments import base_interpreter
from tests.support.trees import fingerprint

MODULE = "mine = 'from the packages'\n"
WHERE = "import mine, sys; result = [mine.mine, sys.path[-1], sys.executable, sys.prefix]"
CHILD = """
import subprocess, sys
code = "import mine, sys; print(mine.mine, sys.prefix)"
result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
"""
STRICT = Confinement(profile="strict")


def with_packages(folder: Path) -> Runtime:
    packages = folder / "packages"
    packages.mkdir()
    (packages / "mine.py").write_text(MODULE)
    (packages / "colorsys.py").write_text(MODULE)
    (packages / "first.pth").write_text("import sys; sys.started = True\n")
    return Runtime(base_interpreter(), str(packages))


@pytest.fixture
def folder() -> Iterator[Path]:
    with open_folder() as folder:
        yield folder


@pytest.fixture
def runtime(folder: Path) -> Runtime:
    return with_packages(folder)


@pytest.fixture(scope="module", params=profiles("strict", "no-userns"))
def cell(request: pytest.FixtureRequest) -> Iterator[Cell]:
    """A jail with these packages, with a private root, and without."""
    confinement = Confinement(profile=request.param)
    with (
        open_folder() as folder,
        spawner_in(folder, confinement, runtime=with_packages(folder)) as spawner,
    ):
        cell = new_cell(spawner, make_snapshot(folder), confinement)
        cell.start()
        yield cell


def test_packages_lie_behind_the_standard_library(cell: Cell) -> None:
    found, last, *_ = cell.run(WHERE)["result"]
    assert (found, last) == ("from the packages", packages_of(cell))
    assert cell.run("import colorsys; result = hasattr(colorsys, 'mine')") == {"result": False}
    assert cell.run("import sys; result = sys.started") == {"result": True}
    assert cell.run("result = callable(exit)") == {"result": True}
    asked = (
        "import os, site; both = [site.getsitepackages()[0], site.USER_SITE]; "
        "result = [os.path.exists(f'{both[0]}/mine.py'), *(path in both[1] for path in "
        "(os.environ['HOME'], site.USER_BASE)), site.ENABLE_USER_SITE]"
    )
    assert cell.run(asked) == {"result": [True, True, True, False]}


def test_packages_are_as_deep_as_paths_go(folder: Path, runtime: Runtime) -> None:
    """A stranger has chosen how deep: deeper than functions of Python call each other."""
    deepest = runtime.packages
    for _ in range(sys.getrecursionlimit() + 100):
        deepest += "/d"
        os.mkdir(deepest)
    with spawner_in(folder, STRICT, runtime=runtime) as spawner:
        cell = new_cell(spawner, make_snapshot(folder), STRICT)
        cell.start()
        told = f"import os; result = os.mkdir({deepest + '/own'!r})"
        assert cell.run(told) == {"result": None}
    remove_tree(Path(runtime.packages))


def test_packages_of_the_interpreter_are_not_there(cell: Cell) -> None:
    paths = cell.run("import sys; result = sys.path")["result"]
    assert not [path for path in paths if "site-packages" in path or "dist-packages" in path]
    assert cell.run("import gymnasium")["error"] == "ModuleNotFoundError"


def test_programs_that_are_started_have_the_packages_too(cell: Cell) -> None:
    _, _, executable, prefix = cell.run(WHERE)["result"]
    assert cell.run(CHILD)["result"].split() == ["from", "the", "packages", prefix]
    assert executable.startswith(f"{prefix}/")
    assert cell.start() == 2  # a second runner finds it made
    assert cell.run(CHILD, runner=2)["result"].split()[-1] == prefix


def packages_of(cell: Cell) -> str:
    return str(Path(cell.jail.spec.snapshot).with_name("packages"))


def test_shared_packages_cannot_be_written(cell: Cell) -> None:
    """Whoever needs the same packages shares the folder; the modes shall not be what saves it."""
    packages = packages_of(cell)
    os.chmod(packages, 0o777)
    was = fingerprint(packages)
    cell.run(f"open({packages + '/added'!r}, 'w')")
    assert fingerprint(packages) == was
    (Path(packages) / "added").write_text("")  # the control
    assert fingerprint(packages) != was


def test_the_zygote_imports_no_package(folder: Path, runtime: Runtime) -> None:
    ahead = ZygoteProcess(runtime, folder, {}, ahead=True)
    with spawner_in(folder, STRICT, runtime=runtime, ahead=ahead) as spawner:
        cell = new_cell(spawner, make_snapshot(folder), STRICT)
        cell.start()
        names = cell.run("import sys; result = sorted(sys.modules)")["result"]
        assert cell.run("import sys; result = sys.flags.hash_randomization")["result"] == 0
        assert inside.zygote_pid(spawner) == ahead.pid
    ours = {name for name in names if name.partition(".")[0] not in sys.stdlib_module_names}
    assert {name.partition(".")[0] for name in ours} <= {"__main__", "__mp_main__", "envhub_worker"}


@pytest.mark.parametrize(
    ("what", "profile"),
    [
        *((what, "strict") for what in ("missing", "closed", "closed inside")),
        pytest.param("closed", "no-userns", marks=needs("no-userns")),
    ],
)
def test_unreadable_ones_are_told(folder: Path, runtime: Runtime, what: str, profile: str) -> None:
    confinement = Confinement(profile=profile)
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


def test_a_server_keeps_packages_from_being_removed(folder: Path, runtime: Runtime) -> None:
    record = folder / RECORD
    record.touch()
    with spawner_in(folder, STRICT, runtime=runtime):
        with pytest.raises(TimeoutError), held(record):
            pass
        assert list(sharers(record)) == [os.getpid()]
    with held(record):
        pass


@pytest.mark.parametrize("what", ["packages", "snapshot"])
def test_what_is_removed_is_no_kernels_fault(folder: Path, runtime: Runtime, what: str) -> None:
    with spawner_in(folder, STRICT, runtime=runtime) as spawner:
        snapshot = make_snapshot(folder)
        cell = new_cell(spawner, snapshot, STRICT)
        cell.start()
        assert cell.run("result = 1") == {"result": 1}
        gone = runtime.packages if what == "packages" else snapshot
        remove_tree(Path(gone))
        late = new_cell(spawner, snapshot, STRICT)
        failed = late.wait_for(JailFailed)
    assert gone in failed.reason
    assert "was removed after this server began to use it" in failed.reason
    assert "call make_env again" in failed.fix


def test_what_every_jail_imports_is_named_where_missing(folder: Path, runtime: Runtime) -> None:
    with spawner_in(folder, STRICT, runtime=runtime, target=RUNNER_TARGET) as spawner:
        cell = new_cell(spawner, make_snapshot(folder), STRICT)
        cell.start()
        assert cell.wait_for(RunnerExited).code == 1
        cell.wait_for_output(b"make the environment again with these")
    assert runtime.packages.encode() in cell.output
    assert b"Traceback" not in cell.output
