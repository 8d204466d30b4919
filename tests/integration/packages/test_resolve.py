"""Requirements become pins with hashes: by uv, from the index that the user chose, wheels only."""

import contextlib
import hashlib
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.declared import parse_requirement
from envhub_sandbox.extras.packages.request import PackageRequest, chosen
from envhub_sandbox.extras.packages.resolution import index as places
from envhub_sandbox.extras.packages.resolution import resolutions, uv
from envhub_sandbox.extras.packages.resolution import resolve as module
from envhub_sandbox.extras.packages.resolution.pylock import Lock
from envhub_sandbox.extras.packages.resolution.resolve import Target
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.sdists import backend, make_sdist
from tests.support.packages.wheels import WORKERS, Index, make_wheel
from tests.unit.docs.test_distributions import project

__all__ = ["project"]
HERE = Target(python=os.path.realpath(sys.executable))


def resolve(*lines: str, target: Target = HERE, **options: Any) -> Lock:
    wanted = [
        parse_requirement(line, f"line {n} of requirements.txt")
        for n, line in enumerate(lines, start=1)
    ]
    refresh = options.pop("refresh", False)
    return module.resolve(
        PackageRequest("requirements.txt", tuple(wanted), **options), target, refresh=refresh
    )


def test_every_package_has_its_version_and_hashes(index: Index) -> None:
    make_wheel(index.folder, "wanted", requires=["its-own>=2"])
    make_wheel(index.folder, "its-own", "2.5")
    lock = resolve("wanted")
    assert set(lock.packages) == {
        *("wanted==1.0", "its-own==2.5"),
        *(f"{name}=={version}" for name, version in WORKERS.items()),
    }
    assert lock.text.count("--hash=sha256:") == len(lock.packages)


def test_another_machines_interpreter_is_described(index: Index) -> None:
    """For an image: wheels that this machine could not use are taken."""
    make_wheel(index.folder, "wanted", tag="cp310-cp310-manylinux_2_28_aarch64")
    assert (
        "wanted==1.0"
        in resolve("wanted", target=Target(version="3.10", machine="aarch64")).packages
    )
    with refused_dependency("resolution"):
        resolve("wanted", target=Target(version="3.10", machine="x86_64"))


def test_no_interpreter_of_somebody_elses_is_asked(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """uv runs the one of a .venv above its working directory: anybody can make one in /tmp."""
    python = tmp_path / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    (tmp_path / ".venv/pyvenv.cfg").write_text(f"home = {os.path.dirname(HERE.python)}\n")
    python.write_text(f'#!/bin/sh\ntouch {tmp_path}/asked\nexec {HERE.python} "$@"\n')
    python.chmod(0o755)
    for name in ("python3", f"python{sys.version_info[0]}.{sys.version_info[1]}"):
        (python.parent / name).symlink_to("python")
    command = [uv.command(), "pip", "compile", "-", *uv.NO_BUILDS, "--python-version", "3.12"]
    (tmp_path / "cwd").mkdir()
    env = places.environment()
    subprocess.run(command, input=b"", capture_output=True, cwd=tmp_path / "cwd", env=env)
    assert (tmp_path / "asked").exists(), "the control asks nobody"
    (tmp_path / "asked").unlink()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for target in (HERE, Target(version="3.12", machine="x86_64")):
        assert resolve("numpy", target=target).packages
    monkeypatch.setenv("PATH", "/nowhere")  # each interpreter there would be asked
    with contextlib.suppress(DependencyError):
        interpreters.find("3.9.1")
    assert not (tmp_path / "asked").exists()


def test_what_jails_import_is_what_the_image_installs(project: dict[str, Any]) -> None:
    """But for ZeroMQ, which no jail has, and what may be older in one."""
    group = set(project["dependency-groups"]["worker"]) - {
        "pyzmq>=25",
        "gymnasium>=1.1",
        "numpy>=1.26",
    }
    assert set(module.WORKERS) == {*group, "gymnasium>=0.26", "numpy>=1.21"}


def test_a_contradiction_names_both_lines(index: Index) -> None:
    make_wheel(index.folder, "one", requires=["shared<2"])
    make_wheel(index.folder, "innocent")
    make_wheel(index.folder, "shared", "1.0")
    make_wheel(index.folder, "shared", "2.0")
    with refused_dependency("resolution") as caught:
        resolve("one", "innocent", "shared>=2")
    said = str(caught.value)
    assert "shared>=2  (line 3 of requirements.txt)" in said
    assert "one  (line 1 of requirements.txt)" in said
    assert "line 2" not in said
    assert "you require" not in said


@pytest.mark.parametrize(
    ("lines", "cure"),
    [
        (("numpy<1.20",), {"override": ["numpy>=1.21"]}),  # the worker's own line
        (("one", "shared>=2"), {"override": ["shared"]}),
        (("one", "nowhere"), {"without": ["nowhere"]}),
        (("unbuilt==2",), {"override": ["unbuilt"]}),
        (("broken",), {"without": ["broken"]}),
    ],
)
def test_the_advice_is_one_with_which_there_are_versions(
    index: Index, monkeypatch: pytest.MonkeyPatch, lines: tuple[str, ...], cure: dict[str, Any]
) -> None:
    monkeypatch.setattr(interpreters, "others", lambda declared, first: [])
    make_wheel(index.folder, "numpy", "1.19")
    make_wheel(index.folder, "one", requires=["shared<2"])
    for version in ("1.0", "2.0"):
        make_wheel(index.folder, "shared", version)
    make_wheel(index.folder, "unbuilt")
    fails = backend("x", further="def further():\n    raise SystemExit('no')\n")
    for name, version in (("unbuilt", "2"), ("broken", "1")):
        make_sdist(index.folder, name, version, fails)
    wanted = tuple(parse_requirement(line, "requirements.txt") for line in lines)
    asked = PackageRequest("requirements.txt", wanted)
    with refused_dependency("resolution", match=re.escape(f"dependencies={cure}")):
        resolutions.resolution_for(asked)
    changed = chosen(cure, None)[0]
    cured = replace(asked, override=changed.override, without=changed.without)
    assert resolutions.resolution_for(cured).lock.packages


def test_requirements_are_left_out_replaced_and_constrained(index: Index) -> None:
    make_wheel(index.folder, "one", requires=["shared", "unwanted"])
    make_wheel(index.folder, "shared", "1.0")
    make_wheel(index.folder, "shared", "2.0")
    without: dict[str, Any] = {"without": ("unwanted",)}
    held = tuple(parse_requirement(text, "line 7 of c.txt") for text in ("shared<2", "absent<1"))
    changed = resolve("one", "unwanted", constraints=held, **without).packages
    assert "shared==1.0" in changed
    assert not [pin for pin in changed if pin.startswith("unwanted")]
    replaced = (parse_requirement("shared>=2", "an argument"),)
    assert "shared==2.0" in resolve("one", "shared<2", override=replaced, **without).packages
    with refused_dependency("resolution", match=r"shared<2  \(line 7 of c.txt\)"):
        resolve("one", "shared>1", constraints=held, **without)


def test_another_python_is_told_from_another_fault(index: Index) -> None:
    make_wheel(index.folder, "newer", python=">=3.99")
    make_wheel(index.folder, "tagged", tag="cp399-cp399-any")
    for name in ("newer", "tagged"):
        with refused_dependency("resolution") as caught:
            resolve(name)
        assert module.is_about_python(caught.value)
    with refused_dependency("resolution", match=r"no-such-package  \(line 1") as caught:
        resolve("no-such-package")
    assert not module.is_about_python(caught.value)


def test_a_hash_of_the_repositorys_is_kept(index: Index) -> None:
    wheels = [make_wheel(index.folder, "wanted", tag=f"{py}-none-any") for py in ("py3", "py31")]
    hashes = [hashlib.sha256(wheel.read_bytes()).hexdigest() for wheel in wheels]
    assert all(known in resolve("wanted").text for known in hashes)
    kept = resolve(f"wanted==1.0 --hash=sha256:{hashes[0]}").text
    assert hashes[0] in kept
    assert hashes[1] not in kept
    with refused_dependency("integrity", match="line 1 of"):
        resolve(f"wanted==1.0 --hash=sha256:{'0' * 64}")


def test_a_release_that_was_taken_back(index: Index) -> None:
    index.yanked.add(make_wheel(index.folder, "wanted").name)
    with refused_dependency("resolution", match=r"(?s)yanked by its authors.*yanked"):
        resolve("wanted")


@pytest.mark.parametrize("strategy", ["first-index", "unsafe-best-match"])
@pytest.mark.parametrize(
    ("status", "said"),
    [(503, "Check the network"), (401, "the right login"), (403, "login"), (407, "HTTPS_PROXY")],
)
def test_no_index(
    index: Index, monkeypatch: pytest.MonkeyPatch, strategy: str, status: int, said: str
) -> None:
    """One that wants a login is not one without the package, as pip's strategy has it."""
    index.broken = status
    monkeypatch.setenv("UV_INDEX_STRATEGY", strategy)
    with refused_dependency("index", match=f"(?s){said}.*{status} "):
        resolve("numpy")


@pytest.mark.parametrize("wrong", ["http://u:hidden@[wrong", "{url}/no?token=hidden"])
def test_no_password_of_an_index_is_in_an_error(
    index: Index, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, wrong: str
) -> None:
    index.broken = 503
    url = os.environ["UV_DEFAULT_INDEX"]
    monkeypatch.setenv("UV_DEFAULT_INDEX", wrong.format(url=url))
    monkeypatch.setenv("UV_EXTRA_INDEX_URL", url)
    with pytest.raises(DependencyError) as caught:
        resolve("numpy")
    assert "hidden" not in f"{caught.value} {caplog.text}"


def test_a_wait_for_an_index_is_told(index: Index, monkeypatch: pytest.MonkeyPatch) -> None:
    """uv itself says nothing as long as the index does not answer."""
    monkeypatch.setattr(uv, "SILENT_S", 0.0)
    index.hold("/simple")
    said: list[str] = []

    def tell(line: str) -> None:
        said.append(line)
        index.let_go()

    request = PackageRequest("x", (parse_requirement("numpy", "line 1"),))
    assert module.resolve(request, HERE, tell=tell, timeout_s=60.0).packages
    assert "uv is still at work" in said[0]


def test_only_uploads_before_a_date(index: Index, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the repository's packages; the worker's may be as new as it needs them, and no newer. The
    day of a release is that of the newest, be it a source."""
    make_sdist(index.folder, "unbuilt")
    make_sdist(index.folder, "unbuilt", "2.0")
    make_wheel(index.folder, "unbuilt", "1.5")
    wheels = [make_wheel(index.folder, "ages", version) for version in ("1.0", "2.0")]
    make_wheel(index.folder, "cloudpickle", "99.0")
    days = {path.name: "2020-01-01" for path in index.folder.iterdir()}
    days[f"cloudpickle-{WORKERS['cloudpickle']}-py3-none-any.whl"] = "2023-10-16"
    days |= {"cloudpickle-99.0-py3-none-any.whl": "2025-01-01", wheels[1].name: "2023-02-01"}
    days["unbuilt-2.0.tar.gz"] = "2022-01-01"
    monkeypatch.setattr(index, "uploaded", days)
    for name, day in (("ages", "2023-02-01"), ("unbuilt", "2022-01-01")):
        assert module.uploaded(parse_requirement(name, "x"), sys.executable) == day
    found = resolve("ages", exclude_newer="2023-01-05").packages
    assert {"ages==1.0", f"cloudpickle=={WORKERS['cloudpickle']}"} <= set(found)
    with pytest.raises(DependencyError):
        resolve("ages", exclude_newer="2019-12-31")


def test_no_setting_of_the_working_directory_counts(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A repository that is run from its own folder could bring one."""
    (tmp_path / "uv.toml").write_text("no-index = true\n")
    (tmp_path / "pyproject.toml").write_text("[tool.uv]\nno-index = true\n")
    monkeypatch.chdir(tmp_path)
    assert resolve("numpy").packages


@pytest.mark.parametrize(
    ("path", "said"),
    [("{folder}", "pip install uv"), ("{folder}:{path}", r"uv before .* pip install")],
)
def test_without_a_uv_that_can_be_used_the_error_says_how_to_get_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, path: str, said: str
) -> None:
    """An old one would put a package's scripts wherever that says."""
    monkeypatch.setitem(sys.modules, "uv", None)
    monkeypatch.setenv("PATH", path.format(folder=tmp_path, path=os.environ["PATH"]))
    if ":" in path:
        (tmp_path / "uv").write_text("#!/bin/sh\necho 'uv 0.11.8 (x86_64-unknown-linux-gnu)'\n")
        (tmp_path / "uv").chmod(0o755)
    with pytest.raises(DependencyError, match=said):
        uv.command()


@pytest.fixture
def another_uv(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], None]:
    def replace(lines: str) -> None:
        version = "if sys.argv[1] == '--version': sys.exit(print('uv 99.0.0'))"
        (tmp_path / "uv").write_text(f"#!{sys.executable}\nimport sys, time\n{version}\n{lines}\n")
        (tmp_path / "uv").chmod(0o755)
        monkeypatch.setitem(sys.modules, "uv", None)
        monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    return replace


def test_who_holds_the_stderr_of_a_uv_that_has_ended_is_not_waited_for(
    another_uv: Callable[[str], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uv, "LISTEN_S", 3.0)
    told = list[str]()
    another_uv(
        "import os\n"
        "if pid := os.fork():\n"
        f"    open({str(tmp_path / 'holder')!r}, 'w').write(str(pid))\n"
        "    sys.exit('its last line')\n"
        "time.sleep(600)\n"
    )
    with pytest.raises(DependencyError, match="its last line"):
        uv.run(["pip"], what="no", timeout_s=600, tell=told.append)
    os.kill(int((tmp_path / "holder").read_text()), signal.SIGKILL)  # it was not waited for
    assert told == ["its last line"]


def test_a_uv_that_is_late_is_ended(another_uv: Callable[[str], None], tmp_path: Path) -> None:
    another_uv(f"time.sleep(30)\nopen({str(tmp_path / 'went on')!r}, 'w')")
    with refused_dependency("index", match="uv was not done after"):
        uv.run(["pip"], what="no", timeout_s=0.1)
    assert not (tmp_path / "went on").exists()


def test_what_uv_prints_is_escaped(another_uv: Callable[[str], None]) -> None:
    """It quotes names of packages, which strangers choose."""
    another_uv(r"sys.exit('no \x1b[2Jname')")
    told = list[str]()
    with pytest.raises(DependencyError) as caught:
        uv.run(["pip"], what="no", timeout_s=60, tell=told.append)
    assert told == ["no \\x1b[2Jname"]
    assert "\x1b" not in str(caught.value)


def test_the_project_asks_for_the_oldest_uv_that_is_taken(project: dict[str, Any]) -> None:
    oldest = ".".join(map(str, uv.OLDEST))
    assert f"uv>={oldest}" in project["project"]["dependencies"]


NO_FILES = {"PIP_CONFIG_FILE": os.devnull}


@pytest.mark.parametrize(
    ("given", "uvs"),
    [
        (
            {
                "PIP_INDEX_URL": "https://mirror.example/simple",
                "PIP_EXTRA_INDEX_URL": "https://a.example https://b.example",
                "PIP_FIND_LINKS": "/wheels /more",
                "PIP_CERT": "/ca.pem",
            },
            {
                "UV_DEFAULT_INDEX": "https://mirror.example/simple",
                "UV_INDEX": "https://a.example https://b.example",
                "UV_FIND_LINKS": "/wheels,/more",
                "SSL_CERT_FILE": "/ca.pem",
            },
        ),
        (
            {"UV_INDEX_URL": "https://u.example", "PIP_INDEX_URL": "https://p.example"},
            {"UV_INDEX_URL": "https://u.example", "UV_DEFAULT_INDEX": None},
        ),
        ({"UV_PYTHON_DOWNLOADS": "automatic"}, {"UV_PYTHON_DOWNLOADS": "never"}),
    ],
    ids=["a mirror that pip knows", "uv's settings before pip's", "no interpreter is downloaded"],
)
def test_the_users_settings_are_uvs(given: dict[str, str], uvs: dict[str, str | None]) -> None:
    """Users behind a mirror have mostly configured pip, and not uv."""
    found = places.environment({**NO_FILES, **given})
    assert {name: found.get(name) for name in uvs} == uvs


def test_a_path_starts_in_the_users_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, version in WORKERS.items():
        make_wheel(tmp_path, name, version)
    monkeypatch.chdir(tmp_path.parent)
    for name in [name for name in os.environ if name.startswith(("UV_", "PIP_"))]:
        monkeypatch.delenv(name)
    settings = {"NO_INDEX": "1", "FIND_LINKS": tmp_path.name, "CONFIG_FILE": os.devnull}
    for name, value in settings.items():
        monkeypatch.setenv(f"PIP_{name}", value)
    monkeypatch.setenv("UV_CACHE_DIR", f"{tmp_path.name}/uv")
    target = Target(version="3.12", machine="x86_64")
    assert set(resolve("numpy", target=target).packages) == {
        f"{name}=={version}" for name, version in WORKERS.items()
    }
    assert (tmp_path / "uv").is_dir()
    given = {**NO_FILES, "UV_FIND_LINKS": "a,https://b.example/c,/d"}
    here = tmp_path.parent
    assert places.environment(given)["UV_FIND_LINKS"] == f"{here}/a,https://b.example/c,/d"


def test_pips_files_are_read_in_pips_order(tmp_path: Path) -> None:
    config, home = tmp_path / "xdg", tmp_path / "home"
    for folder, name in ((config / "pip", "machine"), (home / ".config/pip", "user")):
        folder.mkdir(parents=True)
        (folder / "pip.conf").write_text(f"[global]\nindex-url = https://{name}.example/simple\n")
    variables = {"HOME": str(home), "XDG_CONFIG_DIRS": str(config)}
    assert places.pip_settings(variables)["index-url"] == "https://user.example/simple"
    named = tmp_path / "named.conf"
    named.write_text("[install]\nindex-url = https://named.example/simple\n")
    variables["PIP_CONFIG_FILE"] = str(named)
    assert places.pip_settings(variables)["index-url"] == "https://named.example/simple"
    variables["PIP_INDEX_URL"] = "https://variable.example/simple"
    assert places.pip_settings(variables)["index-url"] == "https://variable.example/simple"


@pytest.mark.parametrize(
    "name",
    [
        *("UV_NO_BUILD_ISOLATION", "UV_CONFIG_FILE", "UV_PROJECT", "UV_CONSTRAINT", "UV_OVERRIDE"),
        *("UV_PYTHON", "UV_NO_BINARY", "UV_LINK_MODE", "UV_REQUIRE_HASHES", "UV_NO_VERIFY_HASHES"),
        *("PYTHONPATH", "PYTHONSTARTUP", "LD_PRELOAD", "VIRTUAL_ENV", "CONDA_PREFIX"),
    ],
)
def test_no_other_variable_gets_through(name: str) -> None:
    """What could turn builds on, take settings from elsewhere, or load code."""
    assert name not in places.environment({**NO_FILES, name: "1"})
