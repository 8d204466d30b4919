"""What others' CI runs of us: the very lines of the action, the job and the hooks are run here."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from typer.testing import CliRunner

from envhub_sandbox.cli.app import app
from envhub_sandbox.extras.sources import toml
from tests.support.plugins import skips
from tests.support.repositories import write_repository

_RECORDS = """#!/bin/sh
case "$1 $3" in
"doctor strict") echo "no user namespaces"; exit 6 ;;
"doctor "*) exit 0 ;;
esac
for one in "$@"; do echo "<$one>"; done
exit ${ENVHUB_CODE:-0}
"""
_INSTALLERS = ("venv", "pip")


def loaded(checkout: Path, name: str) -> Any:
    return yaml.safe_load((checkout / name).read_text())


def run(
    script: str, where: Path | None = None, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run a script as GitHub's runner and GitLab's do; ``where``: the checkout that it judges."""
    return subprocess.run(
        ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", script],
        cwd=where,
        env={"PATH": os.environ["PATH"], **variables},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def program(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


def judged(checkout: Path, folder: Path, code: int = 0, **inputs: str) -> tuple[int, list[str]]:
    """What the action calls ``envhub`` with, for these inputs, and its exit code."""
    action = loaded(checkout, "action.yml")
    step = action["runs"]["steps"][1]
    given = {name: one["default"] for name, one in action["inputs"].items()}
    given |= {name.replace("_", "-"): value for name, value in inputs.items()}
    env = {
        name: given[text.removeprefix("${{ inputs.").removesuffix(" }}")]
        for name, text in step["env"].items()
    }
    program(folder / "envhub" / "bin" / "envhub", _RECORDS)
    done = run(step["run"], RUNNER_TEMP=str(folder), ENVHUB_CODE=str(code), **env)
    assert done.stderr == ""
    return done.returncode, done.stdout.splitlines()


def test_the_action_judges_with_its_inputs(checkout: Path, tmp_path: Path) -> None:
    code, lines = judged(checkout, tmp_path, code=1, ref="./my env", allow="card licence")
    assert code == 1
    assert [line.strip("<>") for line in lines] == [
        *("check", "--github", "--profile", "strict", "--fail-on", "error", "--steps", "200"),
        *("--deadline", "900"),
        *("--allow", "card", "--allow", "licence", "--", "./my env"),
    ]
    _, lines = judged(checkout, tmp_path, deadline="60")
    assert lines[lines.index("<--deadline>") + 1] == "<60>"
    _, lines = judged(checkout, tmp_path, ref="--sandbox=none")
    assert lines[-2:] == ["<-->", "<--sandbox=none>"]
    _, lines = judged(checkout, tmp_path, sarif="a b.sarif")
    assert lines[-4:] == ["<--sarif>", "<a b.sarif>", "<-->", "<./>"]


@pytest.mark.parametrize("hostile", ["$(id)", "`id`", "; id", "'\"", "/*"])
def test_no_input_of_the_action_is_a_script(hostile: str, checkout: Path, tmp_path: Path) -> None:
    """It arrives as it is; the control is a script that it would be part of."""
    _, lines = judged(checkout, tmp_path, ref=hostile)
    assert lines[-2:] == ["<-->", f"<{hostile}>"]
    scripts = [step["run"] for step in loaded(checkout, "action.yml")["runs"]["steps"]]
    assert not [script for script in scripts if "${{" in script]
    assert run(f"printf '<%s>\\n' {hostile}").stdout != f"<{hostile}>\n"


def test_the_action_takes_a_weaker_profile_only_if_named(checkout: Path, tmp_path: Path) -> None:
    """And says why; the first of those that are named, and none where none can be had."""
    code, lines = judged(checkout, tmp_path, profile="strict no-userns")
    assert code == 0
    assert lines[:3] == [
        "this runner cannot enforce the profile strict:",
        "no user namespaces",
        "the profile is no-userns",
    ]
    assert lines[lines.index("<--profile>") + 1] == "<no-userns>"
    code, lines = judged(checkout, tmp_path, profile="strict strict")
    assert code == 6
    assert "<check>" not in lines


def test_the_action_installs_itself(checkout: Path, tmp_path: Path) -> None:
    """The packages of its lock, then its own checkout or what is named, and nothing else."""
    step = loaded(checkout, "action.yml")["runs"]["steps"][0]
    says = '#!/bin/sh\nfor one in "$@"; do echo "<$one>"; done\n'
    program(tmp_path / "bin" / "python3", says)
    program(tmp_path / "envhub" / "bin" / "python", says)
    path = f"{tmp_path / 'bin'}:{os.environ['PATH']}"
    for package, installed in (("", "/the/action"), ("envhub-sandbox==1", "envhub-sandbox==1")):
        env = {"ENVHUB_PACKAGE": package, "ENVHUB_ACTION": "/the/action"}
        done = run(step["run"], **env | {"PATH": path, "RUNNER_TEMP": str(tmp_path)})
        venv = ["<-I>", "<-m>", "<venv>", f"<{tmp_path}/envhub>"]
        pip = ["<-I>", "<-m>", "<pip>", "<install>", "<--quiet>"]
        locked = ["<--require-hashes>", "<--only-binary>", "<:all:>", "<-r>"]
        lock = "</the/action/.ci/locks/action.txt>"
        alone = ["<--no-deps>", "<--no-build-isolation>", f"<{installed}>"]
        assert done.stdout.split() == [*venv, *pip, *locked, lock, *pip, *alone]


def test_nothing_of_the_checkout_runs_in_an_installation(checkout: Path, tmp_path: Path) -> None:
    """Python's own ``-m`` looks in the current folder first; the control is a line without -I."""
    repository = tmp_path / "repository"
    write_repository(repository, "", **{f"{name}__py": "print('unjudged')" for name in _INSTALLERS})
    help_only = f'#!/bin/sh\nexec {sys.executable} "$@" --help\n'  # of the real ones, and no more
    program(tmp_path / "bin" / "python3", help_only)
    program(tmp_path / "envhub" / "bin" / "python", help_only)
    path = f"{tmp_path / 'bin'}:{os.environ['PATH']}"
    given = {"PATH": path, "RUNNER_TEMP": str(tmp_path), "ENVHUB_VENV": f"{tmp_path}/envhub"}
    action = loaded(checkout, "action.yml")["runs"]["steps"][0]["run"]
    lines = [
        *action.replace("\\\n", " ").splitlines(),
        *loaded(checkout, "examples/ci/gitlab.yml")["envhub-check"]["script"],
    ]
    named = [line for line in lines if any(f"-m {name}" in line for name in _INSTALLERS)]
    assert len(named) == 5
    for line in named:
        assert "unjudged" not in run(line, repository, ENVHUB_ACTION="/the/action", **given).stdout
        control = run(line.replace(" -I", ""), repository, ENVHUB_ACTION="/the/action", **given)
        assert control.stdout == "unjudged\n"


def test_the_job_for_gitlab_judges_with_its_variables(checkout: Path, tmp_path: Path) -> None:
    """Its last line is run; the report that it names is the one that GitLab collects."""
    [job] = loaded(checkout, "examples/ci/gitlab.yml").values()
    program(tmp_path / "bin" / "envhub", _RECORDS)
    variables = {**job["variables"], "ENVHUB_VENV": str(tmp_path)}
    done = run(job["script"][-1], **variables)
    assert [line.strip("<>") for line in done.stdout.splitlines()] == [
        *("check", "--profile", "strict", "--fail-on", "error"),
        *("--deadline", "900", "--junit", job["artifacts"]["reports"]["junit"], "--", "./"),
    ]
    assert run(job["script"][-1], ENVHUB_CODE="1", **variables).returncode == 1


def words(checkout: Path, hook: str) -> list[str]:
    [found] = [one for one in loaded(checkout, ".pre-commit-hooks.yaml") if one["id"] == hook]
    assert found["language"] == "python"
    program_name, *words = [*shlex.split(found["entry"]), *found["args"]]
    assert program_name == "envhub"
    assert found["pass_filenames"] is False
    return words


@pytest.mark.parametrize(("text", "code"), [("x = 1", 0), ("x = 'a\u202eb'", 1)])
def test_the_hook_that_reads_fails_for_what_hides(
    text: str, code: int, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_repository(tmp_path, f"{text}\ndef make_env(n_envs=1, use_async_envs=False): pass\n")
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(app, words(checkout, "envhub-static")).exit_code == code


def test_what_is_named_exists(checkout: Path) -> None:
    texts = [
        loaded(checkout, "action.yml")["runs"]["steps"][1]["run"],
        loaded(checkout, "examples/ci/gitlab.yml")["envhub-check"]["script"][-1],
        " ".join(words(checkout, "envhub-check")),
    ]
    done = subprocess.run(
        [sys.executable, "-I", "-m", "envhub_sandbox", "check", "--help-all"],
        capture_output=True,
        text=True,
        env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"},
        check=True,
        timeout=120,
    )
    used = {word for text in texts for word in re.findall(r"--[a-z][a-z-]+", text)}
    assert {"--github", "--junit", "--fail-on"} <= used
    assert [word for word in sorted(used) if word not in done.stdout] == []


# --- What the action and the image install is the same each day


_PYTHONS = ("3.10", "3.11", "3.12", "3.13")


def installs(text: str) -> list[str]:
    """Each command that installs packages, but those of a lock or of no further ones; and images
    that are named by a tag alone."""
    lines = text.replace("\\\n", " ").splitlines()
    found = [line for line in lines if re.search(r"\bpip\W+(install|download|wheel)\b", line)]
    alone = ("--require-hashes", "--no-deps --no-build-isolation")
    found = [line for line in found if not any(option in line for option in alone)]
    images = re.findall(r"^(?:ARG BASE_IMAGE=|FROM )(?!\$\{BASE_IMAGE\})(\S+)", text, re.MULTILINE)
    return [*found, *(one for one in images if not re.search(r"@sha256:[0-9a-f]{64}$", one))]


def unlocked(lock: str, wanted: list[str]) -> list[str]:
    pins = [line for line in lock.replace("\\\n", " ").splitlines() if not line.startswith("#")]
    missing = [pin for pin in pins if not re.search(r"--hash=sha256:[0-9a-f]{64}", pin)]
    for python in _PYTHONS:
        here = {"python_version": python, "python_full_version": f"{python}.1"}
        here |= {"sys_platform": "linux", "implementation_name": "cpython"}
        found = [Requirement(pin.split(" --hash")[0]) for pin in pins]
        found = [one for one in found if one.marker is None or one.marker.evaluate(here)]
        versions = {canonicalize_name(one.name): str(one.specifier)[2:] for one in found}
        assert len(versions) == len(found)
        for one in map(Requirement, wanted):
            version = versions.get(canonicalize_name(one.name), "0")
            needed = one.marker is None or one.marker.evaluate(here)
            if needed and not one.specifier.contains(version):
                missing.append(f"{one} for Python {python}")
    return missing


def test_the_action_and_the_image_install_what_is_locked(checkout: Path) -> None:
    """By hashes that fit ``pyproject.toml``; whether they are complete, pip and CI say."""
    project = toml.loads((checkout / "pyproject.toml").read_text(), 1 << 20)
    groups = project["dependency-groups"]
    wanted = {
        "action": project["project"]["dependencies"] + project["build-system"]["requires"],
        "image": [*groups["worker"], *(one for one in groups["image"] if isinstance(one, str))],
    }
    for name, needs in wanted.items():
        lock = (checkout / ".ci" / "locks" / f"{name}.txt").read_text()
        assert unlocked(lock, needs) == []
        assert len(unlocked(lock, [*needs, "numpy>=99"])) == len(_PYTHONS)
        hashless = re.sub(r"(?m)^(cloudpickle==[^\\]*)\\\n( .*\n)+", r"\1\n", lock)
        assert len(unlocked(hashless, needs)) == 1
    for name in ("action.yml", "Dockerfile"):
        text = (checkout / name).read_text()
        assert installs(text) == []
        assert installs(text.replace("--require-hashes", ""))
    assert installs("ARG BASE_IMAGE=python:3.12-slim\n") == ["python:3.12-slim"]


# --- The documents' site loads nothing from elsewhere: what CI asks of it would find it


def test_the_steps_of_ci_name_tests_that_there_are(checkout: Path) -> None:
    """A step that names a folder which was moved runs no test of it, or leaves nothing out."""
    steps = [checkout / ".ci" / "lib.sh", *(checkout / ".ci" / "steps").iterdir()]
    words = re.findall(r"(?<![\w/$])tests/[\w/.{},]*[\w}]", " ".join(x.read_text() for x in steps))
    named = set(run(f"printf '%s\n' {' '.join(words)}").stdout.split())
    assert {"tests/unit/cli", "tests/attacks/kernel", "tests/remote/ray"} <= named
    assert [one for one in sorted(named) if not (checkout / one).exists()] == []


# --- What failed is run again, alone

_FAILS = """
from pathlib import Path
import pytest

def runs(name):
    path = Path(name)
    path.write_text(path.read_text() + "." if path.exists() else ".")
    return len(path.read_text())

@pytest.mark.parametrize("text", ['an \\u00e9 and a "'])
def test_fails_in_its_first_run(text): assert runs("first") != 1
def test_fails_in_its_fourth_run_too(): assert runs("fourth") not in {1, 4}
@pytest.mark.parametrize("number", range(%d))
def test_always(number): assert runs(f"always{number}") == 0
"""


@pytest.mark.parametrize(("others", "runs"), [(0, 4), (20, 1)])
def test_failures_run_alone_thrice(checkout: Path, tmp_path: Path, others: int, runs: int) -> None:
    """What fails once more fails the run, and more than twenty are not run again. Each failure is
    named when it happens, not only after the last test."""
    (tmp_path / "test_it.py").write_text(_FAILS % others)
    # only the plugin that is named: each of these processes would load all that are installed
    pytest_again = f"bash {checkout}/.ci/again.sh {sys.executable} -m pytest -q -p xdist.plugin"
    pytest_again += f" -p {skips.__name__}"
    env = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTHONPATH": str(checkout)}
    done = run(pytest_again, tmp_path, **env)
    assert done.returncode == 1
    at_once = done.stdout.partition("= FAILURES =")[0]
    assert at_once.count("failed now: test_it.py::test_") == 2 + others
    ran = [len((tmp_path / name).read_text()) for name in ("first", "fourth")]
    assert ran == [runs, runs]
    if others:
        assert "22 failed, which is too many" in done.stdout
        return
    assert [line.partition("[")[0] for line in done.stdout.splitlines()[-2:]] == [
        "FAILED ONCE, passed alone three times: test_it.py::test_fails_in_its_first_run",
        "FAILED AGAIN: test_it.py::test_fails_in_its_fourth_run_too",
    ]
