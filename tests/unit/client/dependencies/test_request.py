"""Where a repository's packages come from: what the caller says, and what this interpreter has."""

import datetime
import json
import os
import platform
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import DependencyError, PolicyError
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.declared import parse_requirement
from envhub_sandbox.extras.packages.modules import MissingModule
from envhub_sandbox.extras.packages.packages import HERE
from envhub_sandbox.extras.packages.request import (
    AUTO,
    DECLARED,
    HOST,
    PackageRequest,
    chosen,
    request_of,
)
from envhub_sandbox.hub.snapshot import Snapshot, local
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import make_wheel

NUMPY = metadata.version("numpy")


def declares(*lines: str, python: str = "") -> PackageRequest:
    wanted = (
        parse_requirement(line, f"line {n} of requirements.txt")
        for n, line in enumerate(lines, start=1)
    )
    return PackageRequest("requirements.txt", tuple(wanted), python)


def snapshot(folder: Path, requirements: str | None = None) -> Snapshot:
    (folder / "env.py").write_text("")
    if requirements is not None:
        (folder / "requirements.txt").write_text(requirements)
    return local(folder)


def test_what_the_caller_says(tmp_path: Path) -> None:
    assert chosen("auto", None) == (AUTO, None)
    assert chosen("host", None) == (HOST, None)
    assert chosen("auto", "python3.12") == (HOST, "python3.12")
    assert chosen("/opt/python", None) == (HOST, Path("/opt/python"))
    assert chosen(tmp_path, None) == (HOST, tmp_path / "bin/python")
    choice, python = chosen({"extra": ["scipy>=1"], "python": "3.12"}, None)
    assert python is None
    assert (choice.where, choice.python) == ("own", "3.12")
    assert [str(wanted) for wanted in choice.extra] == ["scipy>=1"]
    assert chosen("declared", None) == (DECLARED, None)
    only, _ = chosen({"only": ["a>1"], "without": ["B_c"], "override": ["d<2"]}, None)
    assert (list(map(str, only.only or ())), only.infer) == (["a>1"], False)
    assert (only.without, list(map(str, only.override))) == (("b-c",), ["d<2"])
    day = datetime.date(2026, 1, 31)
    assert chosen({"exclude_newer": day}, None)[0].exclude_newer == "2026-01-31"


@pytest.mark.parametrize(
    "wrong",
    [
        *("hots", "", 3, None, {"extras": []}, {"extra": "scipy"}, {"extra": [3]}),
        *({"only": "scipy"}, {"without": ["a<2"]}, {"without": "a"}, {"override": [1]}),
        {"fetch_python": 1},
        *({"python": "soon"}, {"python": 3.11}, {"exclude_newer": "yesterday"}),
        *({"exclude_newer": "2026-01-01 --index-url=x"}, {"exclude_newer": 2026}),
        {"exclude_newer": "2026-02-31"},
    ],
)
def test_what_nobody_could_have_meant_is_refused(wrong: Any) -> None:
    with pytest.raises(PolicyError, match="dependencies"):
        chosen(wrong, None)


@pytest.mark.parametrize(
    ("dependencies", "python", "error", "said"),
    [
        ({"extra": ["a @ file:///tmp/a"]}, None, DependencyError, "in dependencies"),
        ("/opt/python", "/usr/bin/python3", PolicyError, "both"),
        ({"extra": ["scipy"]}, "/usr/bin/python3", PolicyError, "both"),
    ],
)
def test_no_link_and_no_second_interpreter(
    dependencies: Any, python: str | None, error: type[Exception], said: str
) -> None:
    """A link would build something outside of a jail; ``python`` names the packages as well."""
    with pytest.raises(error, match=said):
        chosen(dependencies, python)


@pytest.mark.parametrize(
    ("lines", "python", "unmet"),
    [
        *(((), "", None), (("numpy",), "", None), ((f"numpy=={NUMPY}",), "", None)),
        *((("numpy>=1.26", "gymnasium"), "", None), (("NumPy",), "", None)),
        (("no-such-package; python_version < '3'",), "", None),
        ((), f"=={platform.python_version()}", None),
        (("numpy",), "<3", "python<3"),
        (("gymnasium", "no-such-package"), "", "no-such-package"),
        (("gymnasium", f"numpy!={NUMPY}"), "", f"numpy!={NUMPY}"),
        (("numpy<1",), "", "numpy<1"),
        ((f"numpy=={NUMPY} --hash=sha256:{'0' * 64}",), "", f"numpy=={NUMPY}"),
    ],
)
def test_nothing_is_installed_twice(lines: tuple[str, ...], python: str, unmet: str | None) -> None:
    """By name and version, without importing any; not what has hashes, which nobody can compare."""
    assert interpreters.first_unmet(declares(*lines, python=python)) == unmet


@pytest.mark.parametrize("marker", ["os_name ~= 'posix'", "python_version ~= '3'", "'a' ~= 'b'"])
def test_a_marker_that_says_nothing_is_left_to_uv(marker: str) -> None:
    """It compares what cannot be compared; that is no error of ours."""
    assert str(interpreters.first_unmet(declares(f"numpy; {marker}"))).startswith("numpy; ")


def test_a_python_built_from_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "python_version", lambda: "3.12.1+")
    assert interpreters.first_unmet(declares(python=">=3.12,<3.13")) is None
    assert interpreters.own().version == "3.12.1"
    other = tmp_path / "python3"
    facts = ["cpython", "3.12.2+", "x86_64", "2.36", str(other)]
    other.write_text(f"#!/bin/sh\necho '{json.dumps(facts)}'\n")
    other.chmod(0o755)
    assert interpreters.find(str(other)).version == "3.12.2"


def test_what_is_here_needs_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package that somebody installed without its own packages would not work; extras count."""
    for requires in (["numpy"], ["absent; extra == 'more'"], ["absent"]):
        name = f"here{len(requires[0])}"
        with zipfile.ZipFile(make_wheel(tmp_path, name, requires=requires)) as wheel:
            wheel.extractall(tmp_path / "site")
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert interpreters.first_unmet(declares("here5")) is None
    assert interpreters.first_unmet(declares("here23")) is None
    assert str(interpreters.first_unmet(declares("here23[more]"))).startswith("absent")
    assert interpreters.first_unmet(declares("here6")) == "absent"


def test_only_what_is_missing_makes_an_environment(tmp_path: Path) -> None:
    """``auto`` leaves this interpreter alone where it has all; a mapping never does."""
    own, _ = chosen({}, None)
    for text, auto in ((None, False), ("numpy\n", False), ("no-such-package\n", True)):
        folder = tmp_path / str(text).strip()
        folder.mkdir()
        found = snapshot(folder, text)
        assert request_of(found, HOST) is None
        request = request_of(found, AUTO)
        assert (request is not None and not HERE.meets(request)) == auto
        assert request_of(found, own).always


def test_this_interpreter_without_its_packages_comes_first(tmp_path: Path) -> None:
    """A virtual environment has none that anybody else needs; a path is asked what it is."""
    found = interpreters.find("", ">=3.10")
    assert found == interpreters.own() == interpreters.find(found.path)
    assert Path(found.path).resolve() == Path(found.path)
    assert found.version == platform.python_version()
    with refused_dependency("interpreter", match="does not work as an interpreter"):
        interpreters.find(str(tmp_path / "python"))


@pytest.mark.parametrize(
    ("asked", "declared", "pyenv"), [("3.99", "", "{}"), ("", ">=3.99", "/proc/1/root")]
)
def test_no_interpreter_is_an_error_that_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: str, declared: str, pyenv: str
) -> None:
    """Nothing is downloaded; a pyenv that is closed to us has none, nor one without a program."""
    (tmp_path / "versions/3.99.0/bin").mkdir(parents=True)
    (tmp_path / "versions/3.99.0/bin/python3").write_text("")
    monkeypatch.setenv("PYENV_ROOT", pyenv.format(tmp_path))
    monkeypatch.setenv("PATH", os.path.dirname(interpreters.own().path))  # each there is asked
    with refused_dependency("interpreter", match=rf"uv python install.*{asked or declared}', 'f"):
        interpreters.find(asked, declared)


@pytest.mark.parametrize(
    ("asked", "declared"), [("", ">=3.8,<3.10"), ("3.12", "<3.12"), ("3.9", "")]
)
def test_no_download_is_advised_where_no_release_fits(asked: str, declared: str) -> None:
    with refused_dependency("interpreter", match=r"no release fits.*path/to/python3'}$"):
        interpreters.find(asked, declared)


@pytest.mark.parametrize(("folder", "is_asked"), [("bin", True), ("shims/", False)])
def test_shims_of_pyenv_are_not_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, is_asked: bool
) -> None:
    program = tmp_path / folder / "python3.12"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\necho > '{tmp_path}/asked'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path))
    monkeypatch.setenv("PATH", os.pathsep.join([f"{tmp_path}/{folder}", "/usr/bin", "/bin"]))
    interpreters.others("", interpreters.own())
    assert (tmp_path / "asked").exists() == is_asked


@pytest.mark.parametrize(
    ("place", "choice", "python", "own", "said"),
    [
        ("process", AUTO, None, False, "{'extra': ['NAME-OF-THE-PACKAGE']}"),
        ("process", AUTO, None, True, "{'extra': ['NAME-OF-THE-PACKAGE']}"),
        ("process", HOST, None, False, "leave that out"),
        ("process", HOST, "/opt/python", False, "/opt/python"),
        ("docker", AUTO, None, False, "envhub image build"),
        ("docker", AUTO, None, True, "{'extra': ['NAME-OF-THE-PACKAGE']}"),
        ("remote", AUTO, None, False, "its operator installs"),
        ("remote", AUTO, None, False, "--dependencies"),
        ("remote", AUTO, None, True, "{'extra': ['NAME-OF-THE-PACKAGE']}"),
    ],
)
def test_a_missing_module_has_one_cure(
    tmp_path: Path, place: str, choice: Any, python: Any, own: bool, said: str
) -> None:
    found = snapshot(tmp_path, "numpy>=1\n")
    text = MissingModule(found, place, choice.where, python, own).advice()
    assert said in text
    assert place == "process" or "python=" not in text  # which is refused elsewhere
    assert "Its requirements.txt declares numpy>=1" in text


@pytest.mark.parametrize(
    ("requirements", "said"),
    [(None, "declares no packages"), ("-e .\n", "line 1 of requirements.txt")],
)
def test_declaring_nothing_is_told(tmp_path: Path, requirements: str | None, said: str) -> None:
    found = snapshot(tmp_path, requirements)
    assert said in MissingModule(found, "docker", "auto", None, False).advice()
