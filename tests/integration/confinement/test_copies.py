"""A jail's snapshot and packages are copy on write under their own paths; what is shared stays."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.protocol.confinement import MIB, Confinement, Limits
from envhub_worker.protocol.runtime import Runtime
from tests.support.confinement_kit import (
    Cell,
    RunnerStarted,
    cell_in,
    make_snapshot,
    new_cell,
    open_folder,
    spawner_in,
    unconfined,
    wait_until,
)
from tests.support.interpreter import can_run, needs
from tests.support.packages.environments import base_interpreter
from tests.support.trees import fingerprint

pytestmark = needs("strict")
LIMITS = Limits(disk_bytes=4 * MIB, disk_files=2000)
STRICT = Confinement(profile="strict", limits=LIMITS)

# what packages do: a file beside the code, one in the place of another, folders away and back
WRITING = """
import os, shutil, sys
root = {root!r}
def write(name, text):
    with open(os.path.join(root, name), "w") as file:
        file.write(text)
write("robot/assets/tmp.xml", "<mujoco/>")
os.unlink(root + "/robot/__init__.py")
write("robot/__init__.py", "changed = True")
write("robot/assets/draft", "other")
os.replace(root + "/robot/assets/draft", root + "/robot/assets/scene.xml")
shutil.rmtree(root + "/robot/old")
os.mkdir(root + "/robot/old")
os.rename(root + "/module.py", root + "/moved.py")
os.link(root + "/moved.py", root + "/linked.py")
result = {{
    "old": os.listdir(root + "/robot/old"),
    "assets": sorted(os.listdir(root + "/robot/assets")),
    "scene": open(root + "/robot/assets/scene.xml").read(),
    "top": sorted(os.listdir(root)),
}}
"""
WRITTEN = {
    "old": [],
    "assets": ["mesh.stl", "scene.xml", "tmp.xml"],
    "scene": "other",
    "top": ["linked.py", "moved.py", "robot"],
}


def fill(place: Path) -> Path:
    """Packages as an environment has them: read-only, with folders in folders."""
    for name in ("robot/__init__.py", "robot/assets/mesh.stl", "robot/old/file", "module.py"):
        path = place / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"here = __file__  # {name}\n" if name.endswith(".py") else name)
    (place / "robot/assets/scene.xml").write_text("<mujoco model='own'/>")
    return place


def close(place: Path) -> Path:
    """As an environment is left, once it is complete."""
    for path in [*place.rglob("*"), place]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    return place


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that a jail's user may cross."""
    with open_folder() as folder:
        yield folder


@pytest.fixture
def packages(folder: Path) -> Path:
    return close(fill(folder / "packages"))


@pytest.fixture
def cell(folder: Path, packages: Path) -> Iterator[Cell]:
    runtime = Runtime(base_interpreter(), str(packages))
    with spawner_in(folder, STRICT, runtime=runtime) as spawner:
        cell = new_cell(spawner, make_snapshot(folder), STRICT)
        cell.start()
        yield cell


def outcome(cell: Cell, source: str) -> Any:
    answer = cell.run(source)
    assert "result" in answer, (answer, cell.output)
    return answer["result"]


def test_packages_are_written_in_their_own_place(cell: Cell, packages: Path, folder: Path) -> None:
    """The jail sees all its changes, the next jail none; the shared folder keeps every byte."""
    was = fingerprint(packages)
    source = WRITING.format(root=str(packages))
    assert outcome(cell, source) == WRITTEN
    other = new_cell(cell.spawner, cell.jail.spec.snapshot, STRICT)
    other.start()
    assert outcome(other, source) == WRITTEN  # it finds what the first one found
    assert fingerprint(packages) == was
    control = fill(folder / "control")
    was = fingerprint(control)
    assert unconfined(WRITING.format(root=str(control))) == {"result": WRITTEN}
    assert fingerprint(control) != was


def test_runners_of_a_jail_share_what_they_write(cell: Cell, packages: Path) -> None:
    """One view for a jail, also of a module that is imported later."""
    path = f"{packages}/robot/late.py"
    outcome(cell, f"open({path!r}, 'w').write('here = __file__')")
    [view] = [one for one in cell.wait_for(RunnerStarted).report if one["layer"] == "working-view"]
    assert "copy on write" in view["detail"]
    second = cell.start()
    answer = cell.run("import robot, robot.late; result = [robot.here, robot.late.here]", second)
    assert answer == {"result": [f"{packages}/robot/__init__.py", path]}


def test_snapshot_is_written_under_its_own_path(cell: Cell) -> None:
    """``__file__`` and the working directory lead to the same writable files."""
    snapshot = cell.jail.spec.snapshot
    was = fingerprint(snapshot)
    source = f"""
import os, sys
sys.path.insert(0, {snapshot!r})
import env
beside = os.path.join(os.path.dirname(env.__file__), "assets", "tmp.xml")
open(beside, "w").write("beside")
os.replace("assets/tmp.xml", "assets/a.txt")
result = [env.__file__, open(os.path.join({snapshot!r}, "assets/a.txt")).read()]
"""
    assert outcome(cell, source) == [f"{snapshot}/env.py", "beside"]
    assert fingerprint(snapshot) == was


def test_what_is_written_counts_against_the_scratch(cell: Cell, packages: Path) -> None:
    """Bytes and files: a full scratch is an error in the jail, and nobody else's."""
    was = fingerprint(packages)
    source = f"""
import errno
failed = []
def fill(limit, write):
    try:
        for number in range(limit):
            write(number)
    except OSError as error:
        failed.append(errno.errorcode[error.errno])
place = {str(packages)!r} + "/robot/assets"
def large(number):
    with open(place + "/large", "ab") as file:
        file.write(bytes(1 << 20))
fill(64, large)
import os; os.unlink(place + "/large")
fill({LIMITS.disk_files * 2}, lambda number: open(place + f"/{{number}}", "w").close())
try:
    open(os.environ["HOME"] + "/full", "w").write("x")
except OSError as error:
    failed.append(errno.errorcode[error.errno])
result = failed
"""
    assert outcome(cell, source) == ["ENOSPC"] * 3
    assert fingerprint(packages) == was
    second = cell.start()  # its self-test stands a full scratch
    started = partial(is_confined, cell, second)
    wait_until(started, "the second runner was not confined")
    assert outcome(cell, "result = 1") == 1


def is_confined(cell: Cell, runner: int) -> bool:
    cell.pump()
    return any(isinstance(event, RunnerStarted) and event.runner == runner for event in cell.events)


ADVICE = """
from envhub_worker.runner.described import raised
def advice(path, mode):
    try:
        open(path, mode)
    except OSError as error:
        return raised(error, "step", {root!r}).message
import numpy
places = [({root!r} + "/new", "w"), ({root!r} + "/env.py", "a"), (numpy.__path__[0] + "/new", "w")]
result = [advice(*one) for one in places]
"""


@pytest.mark.parametrize("how", ["strict", "no-userns"])
def test_where_nothing_can_be_mounted_the_error_names_file_and_cure(how: str) -> None:
    """A mount's options are one page: a path of colons, which are escaped, is too long for them."""
    if not can_run(how):
        pytest.skip(f"this host has no {how}")
    confinement = Confinement(profile=how)
    with open_folder() as folder:
        deep = folder.joinpath(*[":" * 250] * 8)
        deep.mkdir(parents=True)
        with spawner_in(folder, confinement) as spawner:
            cell = new_cell(spawner, make_snapshot(deep), confinement)
            cell.start()
            root = cell.jail.spec.snapshot
            created, opened, packages = outcome(cell, ADVICE.format(root=root))
            assert "dependencies={'extra': ['numpy']}" in packages
            for text, path in ((created, f"{root}/new"), (opened, f"{root}/env.py")):
                assert f"{path} is in the repository, which is read-only in this jail" in text
                assert "on Linux 5.11 or later" in text
            report = cell.wait_for(RunnerStarted).report
            [view] = [layer["detail"] for layer in report if layer["layer"] == "working-view"]
            assert "read-only" in view
            assert outcome(cell, "result = open('env.py').read()") == "VALUE = 7\n"


def test_a_shared_file_that_is_opened_to_write_says_how_to_replace_it(folder: Path) -> None:
    """Its mode is that of the store; its folder is the jail's own."""
    with cell_in(folder, STRICT) as cell:
        root = cell.jail.spec.snapshot
        created, opened, _ = outcome(cell, ADVICE.format(root=root))
        assert created is None
        assert f"{root}/env.py is shared and has mode 0444" in opened
        source = f"import os; os.chmod('env.py', 0o644); open({root!r} + '/env.py', 'a').write('#')"
        assert outcome(cell, f"{source}; result = open('env.py').read()") == "VALUE = 7\n#"
