"""A folder is judged as its commit is: the same files and findings, and the same code runs. Of a
list, each is."""

import json
import py_compile
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.extras.judge.checks import Severity
from envhub_sandbox.extras.judge.findings import Report
from envhub_sandbox.extras.judge.judge import judge
from envhub_sandbox.extras.judge.settings import JudgeOptions
from envhub_sandbox.hub.snapshot import snapshot_named
from tests.corpus.entries import Entry
from tests.hub.olah_server import GitRepository, OlahServer
from tests.support.command_line import envhub
from tests.support.repositories import STILL

_ENV = """
import os, sys

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [os.path.join(HERE, folder) for folder in {folders!r}]
for name in {names!r}:
    __import__(name)
import beside

class Telling(Still):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0], {{"ran": ",".join(sorted(sys.ran))}}
"""
_PAYLOAD = """
import os, sys
os.popen("true").close()
sys.ran = [*getattr(sys, "ran", ()), __name__]
"""
_FOLDERS = (
    *("lib", ".cache", ".venv", ".tox", "node_modules", ".ipynb_checkpoints", ".hg", ".svn"),
    *(".mypy_cache", ".pytest_cache", ".ruff_cache"),
)
_NAMES = tuple(f"payload{number}" for number in range(len(_FOLDERS)))


def test_a_file_is_judged_as_it_is_run(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The same files of the folder it lies in, named in one line each time."""
    code = f"import helper\n{STILL}\nopen('secret.txt') if helper.x else None\n"
    for name, text in {"env.py": code, "helper.py": "x = 0\n", "secret.txt": "os.popen"}.items():
        (tmp_path / name).write_text(text)
    command = ["--steps", "2", "--resets", "0"]
    told = []
    for name in ("run", "check"):
        done = envhub(
            name, tmp_path / "env.py", *(command if name == "check" else command[:2]), code=0
        )
        told += [line for line in done.stderr.splitlines() if "the code sees" in line]
    line = f"local file {tmp_path}/env.py: the code sees 2 files of its folder: env.py, helper.py"
    assert told == [line, line]
    judged = judge(JudgeOptions(reference=f"{tmp_path}/env.py", arguments={}, steps=2, resets=0))
    with make_env(f"{tmp_path}/env.py") as suites:
        assert suites.provenance["commit"] == judged.commit == judged.provenance["commit"]
        assert list(suites.provenance["files"]) == ["env.py", "helper.py"]


@pytest.fixture
def hostile(olah: OlahServer, tmp_path: Path) -> tuple[GitRepository, str]:
    """A repository with code wherever a tool would leave it out; its commit."""
    repository = olah.repository("org/hostile-places")
    where = repository.folder
    files = {f"{folder}/{name}.py": _PAYLOAD for folder, name in zip(_FOLDERS, _NAMES, strict=True)}
    files |= {"env.py": STILL + _ENV.format(folders=_FOLDERS, names=(*_NAMES, "without_source"))}
    files |= {"lib/pyvenv.cfg": "", "beside.py": "HARMLESS = 1\n", ".gitignore": "*.pyc\n__*__\n"}
    (where / "payload.py").write_text(_PAYLOAD)
    (where / "__pycache__").mkdir()
    tag = sys.implementation.cache_tag
    for place in (f"__pycache__/beside.{tag}.pyc", "without_source.pyc"):
        mode = py_compile.PycInvalidationMode.UNCHECKED_HASH
        py_compile.compile(where / "payload.py", where / place, invalidation_mode=mode)
    (where / "payload.py").unlink()
    repository.git("add", "--force", ".")
    (where / "data.txt").symlink_to("beside.py")
    return repository, repository.commit(files)


def seen(report: Report) -> set[tuple[str, str, str, int]]:
    """Without the number of steps that a machine had the time for."""
    return {
        (one.id, re.sub(r"[\d,]+ steps", "steps", one.message), one.file, one.line)
        for one in report.findings
    }


def content(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def test_a_folder_is_judged_as_its_commit(
    hostile: tuple[GitRepository, str], olah: OlahServer, hub_cache: Path, tmp_path: Path
) -> None:
    """The payload runs from both, wherever it lies, and both have the same findings."""
    repository, commit = hostile
    repository.git("clone", "--quiet", str(repository.folder), str(tmp_path / "clone"))
    hub: Mapping[str, Any] = {"endpoint": olah.endpoint, "hub_cache_dir": hub_cache, "token": False}
    places = {str(tmp_path / "clone"): {}, f"org/hostile-places@{commit}": hub}
    here, there = (content(snapshot_named(ref, **given).root) for ref, given in places.items())
    assert here == there
    ran, reports = [], []
    for ref, given in places.items():
        with make_env(ref, **given) as suites:
            ran.append(suites.env.reset(seed=0)[1]["ran"][0])
        asked = JudgeOptions(reference=ref, arguments={"n_envs": 1, **given}, steps=3, resets=0)
        reports.append(judge(asked))
    assert ran[0] == ran[1]
    assert set(ran[0].split(",")) == {*_NAMES, "beside", "without_source"}
    assert seen(reports[0]) == seen(reports[1])
    for report in reports:
        found = {one.file for one in report.findings if one.id == "source-process"}
        assert found == {f"{where}/{name}.py" for where, name in zip(_FOLDERS, _NAMES, strict=True)}
        failing = {one.file for one in report.failures(Severity.ERROR)}
        tag = sys.implementation.cache_tag
        assert failing == {f"__pycache__/beside.{tag}.pyc", "without_source.pyc"}


_QUICK = ("--steps", "4", "--resets", "0", "--n-envs", "1", "--memory", "1G")
_HONEST = Entry(group="honest")
_BROKEN = Entry(group="broken", env="def step(self, action):\n    raise RuntimeError('it broke')")


def test_each_of_a_list_is_judged(tmp_path: Path) -> None:
    """In its order, and told with what fails first; files beside it that say otherwise are none."""
    _HONEST.write(tmp_path / "honest")
    _BROKEN.write(tmp_path / "broken")
    (tmp_path / "empty").mkdir()
    forged = {"counts": {"passed": 3}, "results": []}
    (tmp_path / "index.json").write_text(json.dumps(forged))
    names = [str(tmp_path / name) for name in ("honest", "broken", "empty")]
    (tmp_path / "list").write_text("\n".join(["# ours", *names]))
    junit = tmp_path / "junit.xml"
    done = envhub("check", "--all", tmp_path / "list", "--json", "--junit", junit, *_QUICK, code=1)
    document = json.loads(done.stdout)
    assert document["counts"] == {"failed": 1, "not judged": 1, "passed": 1}
    failed, empty, honest = document["results"]
    assert [row["line"] for row in (failed, empty, honest)] == [3, 4, 2]
    [why] = failed["why"]
    assert re.fullmatch(r"runs: env\.py:\d+: RuntimeError: it broke", why)
    assert failed["report"]["passed"] is False
    assert honest["report"]["passed"] is True
    assert empty["report"] is None
    assert "no file 'env.py'" in empty["why"][0]
    said = [line.split("]")[1].split()[0] for line in done.stderr.splitlines() if "[" in line]
    assert said == ["passed", "failed", "not"]
    suites = ElementTree.parse(junit).getroot()
    assert [suite.attrib["failures"] for suite in suites] == ["1", "0", "0"]
    assert [suite.attrib["errors"] for suite in suites] == ["0", "1", "0"]
