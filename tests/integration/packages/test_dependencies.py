"""A repository comes up with nothing but its reference: with its packages, which are not ours."""

import datetime
import importlib.util
import os
import re
import subprocess
import sys
import sysconfig
import venv
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import DependencyError, DependencyReason, LoadError
from envhub_sandbox.extras.judge.judge import judge
from envhub_sandbox.extras.judge.settings import JudgeOptions
from envhub_sandbox.extras.packages.locks.making import locked
from envhub_sandbox.extras.packages.request import Choice
from envhub_sandbox.hub.snapshot import local
from envhub_sandbox.sandboxes.process import BOOTSTRAP
from envhub_sandbox.system.log import DEPENDENCIES
from tests.support.compare import assert_same, rolled
from tests.support.packages.refusals import refused_dependency
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
            assert (suites.env.call("version"), others.env.call("version")) == (("2.0",), ("1.0",))
            assert suites.env.call("where") != others.env.call("where")
    finally:
        packages.broken = 0
    assert len(packages.asked) == asked


def test_a_missing_module_and_its_cure(
    packages: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error has the module, the repository and an argument; with that it runs."""
    folder = write_repository(tmp_path / "forgetful", ENV)
    with pytest.raises(DependencyError, match="No module named 'not_here'") as caught:
        make_env(folder)
    said = str(caught.value)
    assert str(folder) in said
    assert "It declares no packages" in said
    assert "dependencies={'extra': ['NAME-OF-THE-PACKAGE']}" in said
    assert said.count("dependencies=") == 1
    (tmp_path / "not_here.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DependencyError, match=r"is importable here at .*jail cannot see") as caught:
        make_env(folder)
    assert f"NAME.pth in {sysconfig.get_path('purelib')}" in str(caught.value)
    (tmp_path / "setup.py").write_text("")
    with pytest.raises(
        DependencyError, match=f"If you trust .* -m pip install -e {tmp_path}\n"
    ) as caught:
        make_env(folder)
    assert "NAME-OF" not in str(caught.value)
    with make_env(folder, dependencies={"extra": ["not-here"]}) as suites:
        assert suites.env.call("version") == ("2.0",)


def test_what_a_package_imports_undeclared_joins_it(packages: Index, tmp_path: Path) -> None:
    """Once its import has failed, and if our table knows what brings it: an index is never asked
    for a name that a jail has made up. The next time it is known."""
    imports = {"forgets/__init__.py": "import six\nVERSION = six.VERSION\n"}
    make_wheel(packages.folder, "forgets", files=imports)
    make_wheel(packages.folder, "six", "1.5")
    forgets = importing("forgets", version="forgets.VERSION")
    folder = write_repository(tmp_path / "repo", forgets, requirements__txt="forgets\n")
    with pytest.warns(UserWarning, match=r"six is installed, .*a package of it, which imports"):
        made = make_env(folder)
    with made as suites:
        assert suites.env.call("version") == ("1.5",)
        assert [one["module"] for one in suites.provenance["installed"]["inferred"]] == ["six"]
    with warnings.catch_warnings(), make_env(folder, n_envs=2) as suites:
        warnings.simplefilter("error")
        assert suites.env.call("version") == ("1.5", "1.5")
    with pytest.raises(DependencyError, match=r"dependencies={'extra': \['six'\]}"):
        make_env(folder, dependencies="declared")
    make_wheel(packages.folder, "made-up")
    made_up = "raise ModuleNotFoundError(\"No module named 'made_up'\")\n"
    asking = write_repository(tmp_path / "asks", made_up, requirements__txt="forgets\n")
    with pytest.raises(DependencyError, match="made_up"):
        make_env(asking)
    assert not [path for path in packages.asked if "made" in path]


def test_code_of_years_ago_runs_with_packages_of_its_day(packages: Index, tmp_path: Path) -> None:
    """The error says the day, ``"auto"`` means it, a lock keeps it, and a check finds a later one
    that does."""
    for version, text in (("1.0", "new = old = 1\n"), ("2.0", "new = 1\n")):
        make_wheel(packages.folder, "ages", version, files={"ages/__init__.py": text})
    packages.uploaded = dict.fromkeys((one.name for one in packages.folder.iterdir()), "2023-01-01")
    packages.uploaded["ages-2.0-py3-none-any.whl"] = "2026-03-01"
    code = importing("ages", version="ages.old") + "\nages.old\n"
    folder = write_repository(tmp_path / "old", code, requirements__txt="ages\n")
    written = datetime.datetime(2024, 6, 1).timestamp()
    for path in folder.iterdir():
        os.utime(path, (written, written))
    try:
        with pytest.raises(LoadError, match=r"dependencies={'exclude_newer': '2024-06-01'}"):
            make_env(folder)
        for day in ("2024-06-01", "auto"):
            with make_env(folder, dependencies={"exclude_newer": day}) as suites:
                assert "ages==1.0" in suites.provenance["installed"]["packages"]
        kept = locked(local(folder), Choice("auto", exclude_newer="auto"))
        assert kept.exclude_newer == "2024-06-01"
        asked = JudgeOptions(reference=str(folder), arguments={})
        [found] = [one for one in judge(asked).findings if one.id == "loads"]
        assert re.search(r"It starts with dependencies={'exclude_newer': '202[56]-", found.message)
    finally:
        packages.uploaded = {}


FINDER = """
import importlib.util, os, sys
TABLE = {value!r}
class Finder:
    TABLE = TABLE
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        if name not in cls.TABLE: return None
        paths = cls.TABLE[name]
        base = paths if isinstance(paths, str) else paths[0]
        for file in (base, base + ".py", base + "/__init__.py"):
            if os.path.isfile(file): return importlib.util.spec_from_file_location(name, file)
sys.meta_path.append(Finder)
"""
WAYS = ["flat", "single", "redirected", "searched", "linked", "strict", "source", "for_the_user"]
LOCAL = f"import {', '.join(WAYS)}\n" + importing(
    "pathlib",
    sum=f"sum(one.VALUE for one in ({', '.join(WAYS)}))",
    beside="sorted(path.name for path in pathlib.Path(flat.__file__).parents[1].iterdir())",
)


def test_each_way_to_a_module_leads_there_in_a_jail(tmp_path: Path) -> None:
    """Of ``pip install -e`` and ``--user``: tables of finders, links, ``.pth`` files. Of a finder
    and no further: what lies beside its package is here, and not there."""
    base = tmp_path / "projects"
    for number, name in enumerate(WAYS):
        (base / name / name).mkdir(parents=True)
        (base / name / name / "__init__.py").write_text(f"VALUE = {2**number}")
    (base / "single" / "single" / "__init__.py").rename(base / "single.py")
    venv.create(tmp_path / "venv", system_site_packages=True, symlinks=True)
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    site = tmp_path / "venv" / "lib" / version / "site-packages"
    tables = {
        "MAPPING": {"flat": str(base / "flat" / "flat"), "single": str(base / "single")},
        "_redirections": {"redirected": str(base / "redirected" / "redirected" / "__init__.py")},
        "submodule_search_locations": {"searched": [str(base / "searched" / "searched")]},
        "NAMESPACES": {"of another kind": 3, 4: "/", "empty": [None]},  # as any finder may have
    }
    for name, value in tables.items():
        finder = FINDER.format(value=value).replace("TABLE", name)
        (site / f"editable{name}.py").write_text(finder)
    (site / "linked").symlink_to(base / "linked" / "linked")
    ours = [*filter(os.path.isabs, sys.path), Path(__file__).parents[3], BOOTSTRAP.parents[1]]
    strict = base / "strict" / "build" / "__editable__.strict-1"
    (strict / "strict").mkdir(parents=True)
    (strict / "strict" / "__init__.py").symlink_to(base / "strict" / "strict" / "__init__.py")
    named = [*ours, base / "source", strict]
    lines = [*map(str, named), *(f"import editable{name}" for name in tables)]
    (site / "all.pth").write_text("\n".join(lines))
    mine = tmp_path / "home" / ".local" / "lib" / version / "site-packages"
    mine.mkdir(parents=True)
    (base / "for_the_user" / "for_the_user").rename(mine / "for_the_user")
    (base / "flat" / "secret.txt").write_text("")
    folder = write_repository(tmp_path / "repo", LOCAL)
    code = "import sys; from envhub_sandbox import make_env\n"
    code += (
        "with make_env(sys.argv[1], n_envs=1) as s: print(s.env.call('sum'), s.env.call('beside'))"
    )
    done = subprocess.run(
        [tmp_path / "venv" / "bin" / "python", "-c", code, folder],
        env={**os.environ, "HOME": str(tmp_path / "home")},
        capture_output=True,
        text=True,
    )
    assert done.stdout == f"({2 ** len(WAYS) - 1},) (['flat'],)\n", done.stderr


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
    ("requirements", "reason", "said"),
    [
        ("numpy\n-e .\n", "requirement", "line 2 of requirements.txt"),
        ("not-here>=3\n", "resolution", "line 1 of requirements.txt; installed here from file://"),
    ],
)
def test_an_error_names_the_repository_and_runs_nothing(
    packages: Index,
    tmp_path: Path,
    requirements: str,
    reason: DependencyReason,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a package that is here from a folder, too: the index may have another of that name."""
    metadata = tmp_path / "site" / "not_here-2.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: not-here\nVersion: 2.0\n")
    (metadata / "direct_url.json").write_text('{"dir_info": {}, "url": "file:///not-here"}')
    monkeypatch.syspath_prepend(metadata.parent)
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt=requirements)
    with refused_dependency(reason, match=said) as caught:
        make_env(folder)
    assert str(caught.value).startswith(f"{folder}:env.py: ")


@pytest.fixture(autouse=True, scope="module")
def _no_network(packages: Index) -> Iterator[None]:
    """Whatever these tests ask for, they ask the index on loopback."""
    yield
    assert all(path.startswith(("/simple/", "/files/")) for path in packages.asked)
