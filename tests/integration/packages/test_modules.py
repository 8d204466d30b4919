"""What a repository imports and does not declare is installed for it, where it is known what."""

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import DependencyError, PolicyError, load_error, remote_error
from envhub_sandbox.extras.packages import interpreters, packages
from envhub_sandbox.extras.packages.interpreters import Interpreter
from envhub_sandbox.extras.packages.locks import day
from envhub_sandbox.extras.packages.locks.day import of_its_day, written
from envhub_sandbox.extras.packages.modules import MissingModule, guessed, note_missing
from envhub_sandbox.extras.packages.packages import packages_for
from envhub_sandbox.extras.packages.request import (
    AUTO,
    DECLARED,
    PackageRequest,
    chosen,
    request_of,
)
from envhub_sandbox.extras.packages.resolution import resolutions
from envhub_sandbox.extras.packages.resolution import resolve as resolving
from envhub_sandbox.extras.packages.resolution.pylock import Lock
from envhub_sandbox.extras.packages.resolution.resolve import Target
from envhub_sandbox.extras.packages.source import RepositoryPackages
from envhub_sandbox.extras.sources import parsing
from envhub_sandbox.hub.snapshot import Snapshot, local, snapshot_named
from tests.hub.stub_hub import StubHub
from tests.support import inside
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import Index, locked, make_wheel

pytestmark = pytest.mark.usefixtures("snapshot_store")
MAKE = "\ndef make_env(n_envs=1, use_async_envs=False): ..."


def snapshot(folder: Path, text: str, **files: str) -> Snapshot:
    """A repository of this entry file; ``__`` in other names is a dot."""
    folder.mkdir(exist_ok=True)
    (folder / "env.py").write_text(text)
    for name, content in files.items():
        (folder / name.replace("__", ".")).write_text(content)
    return local(folder)


def requirements(found: Snapshot) -> list[str]:
    return [str(one.wanted.requirement) for one in guessed(found)]


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("import cv2" + MAKE, ["opencv-python-headless"]),
        ("from google.protobuf import message" + MAKE, ["protobuf"]),
        ("import os, numpy, gymnasium.wrappers, nobody_knows_this" + MAKE, []),
        ("def make_env():\n    import chess", ["chess"]),
        ("def make_env(): return C()\nclass C:\n  def render(self):\n    import chess", ["chess"]),
        ("try:\n  import chess\nexcept ImportError as e:\n  raise E from e" + MAKE, ["chess"]),
        ("try:\n  import chess\nfinally:\n  pass" + MAKE, ["chess"]),
        ("r(id='a', entry_point='chess.envs:C')" + MAKE, ["chess"]),
        ("import importlib\nx = importlib.import_module('chess')" + MAKE, ["chess"]),
        ("import gymnasium\nx = gymnasium.make('Ant-v5')" + MAKE, ["gymnasium[mujoco]"]),
        (
            "import gymnasium as g\ng.make('CartPole-v1', render_mode='human')\n"
            "g.make('Taxi-v3', render_mode=None), g.make('Pendulum-v1')" + MAKE,
            ["gymnasium[classic-control]"],
        ),
        (
            "x = 'LunarLander-v3', 'ALE/Pong-v5', 'CartPole-v1'" + MAKE,
            ["gymnasium[box2d]", "gymnasium[atari]"],
        ),
        # what it does without, or nothing leads to
        ("try:\n  import chess\nexcept ImportError:\n  chess = None" + MAKE, []),
        ("try:\n  import chess\nexcept Exception:\n  pass" + MAKE, []),
        ("import contextlib\nwith contextlib.suppress(ImportError):\n  import chess" + MAKE, []),
        ("from importlib.util import find_spec\nif find_spec('chess'):\n  import chess" + MAKE, []),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n  import chess" + MAKE, []),
        ("if __name__ == '__main__':\n  import chess" + MAKE, []),
        ("def train():\n  import chess" + MAKE, []),
    ],
)
def test_what_it_needs_is_read_off_its_text(tmp_path: Path, text: str, wanted: list[str]) -> None:
    assert requirements(snapshot(tmp_path / "r", text)) == wanted


def test_a_commit_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It costs a process; what was read is remembered, also by the next process."""
    found = snapshot(tmp_path / "r", "import chess" + MAKE)
    assert requirements(found) == ["chess"]
    monkeypatch.setattr(parsing, "read", lambda snapshot: pytest.fail("read again"))
    monkeypatch.setattr(*inside.IMPORTS_IN_MEMORY, {})
    assert requirements(found) == ["chess"]


def test_it_is_installed_and_told(index: Index, tmp_path: Path) -> None:
    for name in ("declared", "chess"):
        make_wheel(index.folder, name)
    found = snapshot(tmp_path / "r", "import chess" + MAKE, requirements__txt="declared\n")
    with pytest.warns(UserWarning, match=r"chess is installed, .*env\.py, line 1"):
        first = packages_for(found, AUTO)
    assert {"declared==1.0", "chess==1.0"} <= set(first.facts["packages"])
    assert [one["module"] for one in first.facts["inferred"]] == ["chess"]
    assert packages_for(found, AUTO) == first
    strict = packages_for(found, DECLARED)
    assert "chess==1.0" not in strict.facts["packages"]
    assert "inferred" not in strict.facts


@pytest.mark.parametrize(
    ("module", "brings"), [("cv2", "opencv-contrib-python"), ("pygame", "pygame")]
)
def test_what_a_declared_package_brings_is_declared(
    index: Index, tmp_path: Path, module: str, brings: str
) -> None:
    for name, requires in (("declared", [brings]), (brings, []), ("pygame-ce", [])):
        make_wheel(index.folder, name, requires=requires)
    found = snapshot(tmp_path / "r", f"import {module}" + MAKE, requirements__txt="declared\n")
    resolved = packages_for(found, chosen({}, None)[0])
    assert "inferred" not in resolved.facts


def test_no_index_is_asked_for_the_name_of_a_module(index: Index, tmp_path: Path) -> None:
    make_wheel(index.folder, "nobody-knows-this")
    make_wheel(index.folder, "chess")
    found = snapshot(tmp_path / "r", "import nobody_knows_this, chess" + MAKE)
    with pytest.warns(UserWarning, match="chess is installed"):
        assert packages_for(found, AUTO) is not None
    assert any("chess" in path for path in index.asked)
    assert not any("nobody" in path for path in index.asked)
    missing = MissingModule(found, "process", "auto", None, True)
    said = missing.advice("No module named 'nobody_knows_this'")
    assert "env.py, line 1 imports nobody_knows_this" in said
    assert "{'extra': ['NAME-OF-THE-PACKAGE']}" in said
    for module, said in (
        ("cv2", "{'extra': ['opencv-python-headless']}"),
        ("google.protobuf", "{'extra': ['protobuf']}"),
        ("numpy.nosuch", "numpy is there, and has no numpy.nosuch"),
        ("cgi", "{'python': '3.12', 'fetch_python': True}"),
        ("its_package_knows_this", "An installed package imports its_package_knows_this"),
    ):
        missing = MissingModule(found, "process", "auto", None, True)
        advice = missing.advice(f"No module named '{module}'")
        assert said in advice


def test_a_jail_names_few_modules(tmp_path: Path) -> None:
    """Of those of the table alone, each once, and none that every jail has: every one costs another
    environment."""
    found = snapshot(tmp_path / "r", "import chess" + MAKE)
    names = ("made_up", "chess", "numpy.core.x", "six", "six", "cv2", "h5py", "scipy", "torch")
    taken = [note_missing(found, f"No module named '{name}'") for name in names]
    assert taken == [False, False, False, True, False, True, True, True, False]
    assert len(requirements(found)) == 5


def test_what_took_names_away_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is loaded, and not in a later step; a repository of today, or of no day, gets no date,
    unlike one of years ago: there a package that raises for no reason may be too new."""
    found = snapshot(tmp_path / "r", MAKE)
    for text, said in (
        ("`np.float_` was removed in the NumPy 2.0 release.", "{'extra': ['numpy<2']}"),
        ("module 'numpy' has no attribute 'int'", "{'extra': ['numpy<1.24']}"),
        ("'Space' object has no attribute 'x'", ""),
    ):
        error = load_error("AttributeError", "it failed")
        error.__cause__ = remote_error("AttributeError", "AttributeError", text, "")
        advice = of_its_day(found, error)
        assert said in advice
        assert bool(advice) == bool(said)
        assert of_its_day(found, error.__cause__) == ""
    os.utime(Path(found.repo_id, "env.py"), (1_600_000_000, 1_600_000_000))
    dated = "{'exclude_newer': '2020-09-13'}"
    inside, own = '  File "/x/packages/mujoco/x.py", line 1\n', "  File env.py, line 1\n"
    for kind, text, traceback, is_dated in (
        ("AttributeError", "'X' has been renamed with `wrappers.X`", "", True),
        ("AttributeError", "module 'numpy' has no attribute 'int'", "", True),
        ("AssertionError", "", own + inside, True),
        ("AssertionError", "", inside + own, False),
        ("FileNotFoundError", "data.txt", inside, False),
    ):
        error = load_error(kind, "it failed")
        error.__cause__ = remote_error(kind, kind, text, traceback)
        assert (dated in of_its_day(found, error)) == is_dated
    error.__cause__ = remote_error("AttributeError", "AttributeError", "has been renamed", "")
    assert dated in of_its_day(found, error)
    monkeypatch.setattr(day, "_of_files", lambda snapshot: "2024-02-30")
    assert of_its_day(found, error) == ""


def test_only_what_has_versions_is_advised(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An earlier release that fits; else in place of the pin; else in an earlier Python; else none,
    as no earlier day is. What is named is had."""
    monkeypatch.setattr(interpreters, "others", lambda declared, first: [])
    other = "3.10" if sys.version_info[:2] != (3, 10) else "3.11"
    earlier = {"text": ("numpy<1.24", other, "2022-12-18")}
    monkeypatch.setattr(day, "_BROKEN_BY", earlier)
    error = load_error("AttributeError", "it failed")
    error.__cause__ = remote_error("AttributeError", "AttributeError", "text", "")
    loose = snapshot(tmp_path / "loose", MAKE, requirements__txt="numpy\n")
    pinned = snapshot(tmp_path / "pinned", MAKE, requirements__txt="numpy>=2\n")
    source = RepositoryPackages(AUTO, None, None)
    said = [source.of_its_day(loose, packages.HERE, error)]
    for tag in (f"cp{other.replace('.', '')}-none-any", "py3-none-any"):
        make_wheel(index.folder, "numpy", "1.23", tag=tag)
        for found in (loose, pinned):
            said.append(source.of_its_day(found, packages.HERE, error))
    keys: list[dict[str, Any]] = [{"extra": ["numpy<1.24"]}, {"override": ["numpy<1.24"]}]
    python = {"python": other, "fetch_python": True}
    for text, named in zip(said, (None, keys[0] | python, keys[1] | python, *keys), strict=True):
        assert ("numpy<1.24 does not fit" if named is None else f"dependencies={named}") in text
    for found, choice in ((loose, keys[0]), (pinned, keys[1])):
        made = packages_for(found, chosen(choice, None)[0])
        assert made is not None
        assert "numpy==1.23" in made.facts["packages"]
    old = snapshot(tmp_path / "loose", MAKE, requirements__txt="numpy>99\n")
    for path in Path(old.repo_id).iterdir():
        os.utime(path, (1_600_000_000, 1_600_000_000))
    error.__cause__ = remote_error("AttributeError", "AttributeError", "has been renamed", "")
    assert source.of_its_day(old, packages.HERE, error) == ""


def test_the_day_of_a_commit_is_asked_where_it_is_from(
    stub_hub: StubHub, hub_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A private repository's name goes to no other Hub."""
    with StubHub() as everybody:
        monkeypatch.setenv("HF_ENDPOINT", everybody.endpoint)
        stub_hub.add("org/repo", {"env.py": MAKE})
        found = snapshot_named(
            "org/repo", hub_cache_dir=hub_cache, endpoint=stub_hub.endpoint, token=False
        )
        assert written(found) == "2024-05-31"
        assert not [asked for asked in everybody.requests if "repo" in asked]


def test_no_guess_hinders(index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is declared comes without it; where nothing is declared, this interpreter serves."""
    monkeypatch.setattr(interpreters, "others", lambda declared, first: [])
    make_wheel(index.folder, "declared")
    found = snapshot(tmp_path / "r", "import chess" + MAKE, requirements__txt="declared\n")
    resolved = packages_for(found, AUTO)
    assert "declared==1.0" in resolved.facts["packages"]
    assert "inferred" not in resolved.facts
    assert packages_for(snapshot(tmp_path / "s", "import chess" + MAKE), AUTO) is None
    with refused_dependency("resolution", match="chess"):
        packages_for(snapshot(tmp_path / "s", "import chess" + MAKE), chosen({}, None)[0])


def test_what_is_here_is_not_installed(index: Index, tmp_path: Path) -> None:
    found = snapshot(tmp_path / "r", "import rich, zmq" + MAKE)
    assert requirements(found) == ["rich", "pyzmq"]
    assert packages_for(found, AUTO) is None
    assert index.asked == []


@pytest.mark.parametrize(
    ("dependencies", "wanted", "guessed"),
    [
        ({"only": ["b"]}, ["b"], []),
        ({"only": []}, [], []),
        ({"extra": ["b"]}, ["a", "b"], ["chess"]),
        ({"without": ["chess"]}, ["a"], []),
        ({"without": ["needed-by-a"]}, ["a"], ["chess"]),
    ],
)
def test_the_caller_has_the_last_word(
    tmp_path: Path, dependencies: Any, wanted: list[str], guessed: list[str]
) -> None:
    found = snapshot(tmp_path / "r", "import chess" + MAKE, requirements__txt="a\n")
    with pytest.raises(PolicyError, match=r"has 'ches' \(did you mean 'chess'\?\)"):
        request_of(found, chosen({"without": ["ches"]}, None)[0])
    request = request_of(found, chosen(dependencies, None)[0])
    assert list(map(str, request.wanted)) == wanted
    assert [one.module for one in request.guesses] == guessed


def test_an_extra_of_its_own_says_which(tmp_path: Path) -> None:
    """By name or by the table, with its versions; also of a module that the table lacks."""
    project = "[project]\nname = 'x'\n[project.optional-dependencies]\n"
    project += "all = ['chess<2', 'nobody-knows-this>1', 'unrelated']\n"
    text = "import chess, nobody_knows_this" + MAKE
    found = snapshot(tmp_path / "r", text, pyproject__toml=project)
    assert requirements(found) == ["chess<2", "nobody-knows-this>1"]


# --- another interpreter --------------------------------------------------------------------


OURS = interpreters.own()
OTHERS = [replace(OURS, version=version) for version in ("3.99.1", "3.98.0")]


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A machine with two other releases, where uv has versions for the last of them alone."""
    found: list[str] = []
    by_path = {f"/opt/{one.version}": one for one in OTHERS}
    others = [replace(one, path=path) for path, one in by_path.items()]
    monkeypatch.setattr(interpreters, "others", lambda declared, first: others)

    def resolve(request: PackageRequest, target: Target, **options: Any) -> Lock:
        found.append(target.python)
        if any(one.requirement.name == "nowhere" for one in request.wanted):
            raise DependencyError("nowhere: not found in the package registry", reason="resolution")
        if target.python != "/opt/3.98.0" or request.wanted[0].requirement.name == "never":
            raise DependencyError(
                "does not satisfy Python>=3.98 and a depends on Python>=3.98", reason="resolution"
            )
        return locked("a==1")

    monkeypatch.setattr(resolving, "resolve", resolve)
    return found


def request(name: str, **fields: Any) -> PackageRequest:
    wanted = resolving.parse_requirement(name, "line 1 of requirements.txt")
    return PackageRequest("requirements.txt", (wanted,), **fields)


def test_a_release_is_tried_and_kept(tried: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    stamps = {"/opt/3.98.0": [1, 1]}
    monkeypatch.setattr(*inside.TELLING_RELEASES_APART, lambda one: stamps.get(one.path, [0, 0]))
    found = resolutions.resolution_for(request("a"))
    assert found.interpreter.version == "3.98.0"
    assert tried == [OURS.path, "/opt/3.99.1", "/opt/3.98.0"]
    assert resolutions.resolution_for(request("a")) == found
    assert len(tried) == 3
    stamps["/opt/3.98.0"] = [1, 2]  # another release under its name
    resolutions.resolution_for(request("a"))
    assert len(tried) == 6


def test_all_that_were_tried_are_named(tried: list[str]) -> None:
    with refused_dependency("resolution") as caught:
        resolutions.resolution_for(request("never"))
    said = str(caught.value)
    assert f"Python {OURS.version}, 3.99.1, 3.98.0 of this machine were tried" in said
    assert "{'python': '3.98', 'fetch_python': True}" in said


@pytest.mark.parametrize(
    ("name", "fields"), [("nowhere", {}), ("never", {"python": OURS.version[:4]})]
)
def test_no_release_is_tried_in_vain(tried: list[str], name: str, fields: dict[str, Any]) -> None:
    """Where Python is not the matter, or the caller has chosen it."""
    with refused_dependency("resolution") as caught:
        resolutions.resolution_for(request(name, **fields))
    assert set(tried) == {OURS.path}
    assert ("fetch_python" in str(caught.value)) == bool(fields)


def test_uv_fetches_an_interpreter_only_where_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    here: list[Interpreter] = []
    monkeypatch.setattr(*inside.FINDING_INTERPRETERS, lambda wanted: list(here))

    def run(arguments: Any, **options: Any) -> str:
        asked.append((arguments[:2], arguments[-1], options["variables"]["UV_PYTHON_DOWNLOADS"]))
        here.append(OTHERS[0])
        return ""

    monkeypatch.setattr(interpreters.uv, "run", run)
    with refused_dependency("interpreter", match="fetch_python"):
        interpreters.find("3.99")
    assert asked == []
    assert interpreters.find("3.99", fetch=True) == OTHERS[0]
    [(words, versions, downloads)] = asked
    assert (words, downloads) == (["python", "install"], "manual")
    assert "==3.99.*" in versions
