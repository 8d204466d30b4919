"""A repository comes up with nothing but its reference: with its packages, which are not ours."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import DependencyError, RequirementError, ResolutionError
from envhub_sandbox.system.log import DEPENDENCIES
from tests.support.compare import assert_same, rolled
from tests.support.packages.wheels import Index, make_wheel
from tests.support.repositories import CARTPOLE, CARTPOLES, importing, write_repository

ENV = importing("not_here", version="not_here.VERSION", where="not_here.__file__")


@pytest.fixture(scope="module")
def packages(real_index: Index) -> Index:
    """An index with two versions of a package that is not installed here."""
    for version in ("1.0", "2.0"):
        make_wheel(real_index.folder, "not-here", version)
    return real_index


def test_it_gets_what_it_declares(packages: Index, tmp_path: Path) -> None:
    """In the jail, and not here; the results are those of this process."""
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt="not-here<2\n")
    with make_env(folder, n_envs=2) as suites:
        assert suites.env.call("version") == ("1.0", "1.0")
        found = rolled(suites.env)
        installed = suites.provenance["installed"]
    namespace: dict[str, Any] = {}
    exec(CARTPOLES, namespace)
    assert_same(rolled(namespace["cartpoles"](2)), found)
    assert "not-here==1.0" in installed["packages"]
    assert installed["lock"].startswith("sha256:")
    assert "not_here" not in sys.modules
    assert importlib.util.find_spec("not_here") is None


def test_once_made_it_needs_no_index(packages: Index, tmp_path: Path) -> None:
    """Nor uv: nothing happens but that the folder is found. One that contradicts it runs beside."""
    script = "# /// script\n# dependencies = ['not-here==2.0']\n# ///\n"
    folder = write_repository(tmp_path / "repo", script + ENV)
    with make_env(folder) as suites:
        assert suites.env.call("version") == ("2.0",)
    older = write_repository(tmp_path / "older", ENV, requirements__txt="not-here==1.0\n")
    make_env(older).close()
    packages.broken, asked = 503, len(packages.asked)
    try:
        with make_env(folder) as suites, make_env(older) as others:
            assert suites.env.call("version") == ("2.0",)
            assert others.env.call("version") == ("1.0",)
            assert suites.env.call("where") != others.env.call("where")
    finally:
        packages.broken = 0
    assert len(packages.asked) == asked


def test_a_missing_module_and_its_cure(packages: Index, tmp_path: Path) -> None:
    """The error has the module, the repository and an argument; with that it runs."""
    folder = write_repository(tmp_path / "forgetful", ENV)
    with pytest.raises(DependencyError, match="No module named 'not_here'") as caught:
        make_env(folder)
    said = str(caught.value)
    assert str(folder) in said
    assert "It declares no packages" in said
    assert "dependencies={'extra': ['NAME-OF-THE-PACKAGE']}" in said
    assert said.count("dependencies=") == 1
    with make_env(folder, dependencies={"extra": ["not-here"]}) as suites:
        assert suites.env.call("version") == ("2.0",)


def test_this_interpreter_is_used_when_it_is_asked_for(packages: Index, tmp_path: Path) -> None:
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt="not-here\n")
    with pytest.raises(DependencyError, match=r"declares not-here.*leave that out"):
        make_env(folder, dependencies="host")


def test_nothing_is_made_where_nothing_is_missing(
    packages: Index, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A repository whose packages are all here runs in this interpreter, as fast as ever."""
    folder = write_repository(
        tmp_path / "repo", CARTPOLE, requirements__txt="gymnasium\nnumpy>=1.26\n"
    )
    asked = len(packages.asked)
    with caplog.at_level("INFO", DEPENDENCIES.name), make_env(folder) as suites:
        suites.env.reset(seed=0)
        assert suites.provenance["installed"] is None
    assert not [record for record in caplog.records if record.name == DEPENDENCIES.name]
    assert len(packages.asked) == asked


@pytest.mark.parametrize(
    ("requirements", "error", "said"),
    [
        ("numpy\n-e .\n", RequirementError, "line 2 of requirements.txt"),
        ("not-here>=3\n", ResolutionError, "line 1 of requirements.txt"),
    ],
)
def test_an_error_names_the_repository_and_runs_nothing(
    packages: Index, tmp_path: Path, requirements: str, error: type[Exception], said: str
) -> None:
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt=requirements)
    with pytest.raises(error, match=said) as caught:
        make_env(folder)
    assert str(caught.value).startswith(f"{folder}:env.py: ")


@pytest.fixture(autouse=True, scope="module")
def _no_network(packages: Index) -> Iterator[None]:
    """Whatever these tests ask for, they ask the index on loopback."""
    yield
    assert all(path.startswith(("/simple/", "/files/")) for path in packages.asked)
