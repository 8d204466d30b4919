"""Where there is no wheel: what is chosen is handed to a builder, and its wheel counts then."""

from __future__ import annotations

import hashlib
import io
import tarfile
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from envhub_sandbox.dependencies import interpreters, packages, resolutions
from envhub_sandbox.dependencies.declared import Source, of_git, parse_requirement
from envhub_sandbox.dependencies.interpreters import Interpreter
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.errors import RequirementError, ResolutionError
from tests.support.packages.wheels import Index, make_wheel

COMMIT = "0123456789abcdef0123456789abcdef01234567"


def request(*lines: str) -> PackageRequest:
    wanted = (parse_requirement(line, f"line {n}") for n, line in enumerate(lines, start=1))
    return PackageRequest("requirements.txt", tuple(wanted))


def source_distribution(folder: Path, name: str, version: str, built: Path) -> str:
    """One whose setup.py leaves a file; returns its hash."""
    code = f"open({str(built)!r}, 'w')".encode()
    path = folder / f"{name.replace('-', '_')}-{version}.tar.gz"
    with tarfile.open(path, "w:gz") as archive:
        entry = tarfile.TarInfo(f"{name}-{version}/setup.py")
        entry.size = len(code)
        archive.addfile(entry, io.BytesIO(code))
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Source]:
    """What a builder was handed, whose wheels need more from the index."""
    seen: list[Source] = []
    needs = {
        "only-source": ["deeper-source"],
        "half-source": ["deeper-source"],
        "of-git": ["only-wheel"],
    }

    def build(
        sources: Sequence[Source], interpreter: Interpreter, tell: Callable[[str], None]
    ) -> list[Path]:
        seen.extend(sources)
        folders = [tmp_path / "made" / one.name for one in sources]
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
        return [
            make_wheel(folder, one.name, one.version or "3.0", requires=needs.get(one.name, ()))
            for folder, one in zip(folders, sources, strict=True)
        ]

    monkeypatch.setattr(resolutions, "BUILDER", build)
    monkeypatch.setattr(interpreters, "others", lambda declared, first: [])
    return seen


def test_a_source_is_chosen_and_built_by_none_but_the_builder(
    index: Index, tmp_path: Path, built: list[Source]
) -> None:
    """What its wheel needs is looked at then, and may be a source again; both are installed."""
    hashes = {
        name: source_distribution(index.folder, name, "1.5", tmp_path / "ran")
        for name in ("only-source", "deeper-source")
    }
    made = packages.HERE.make(request("only-source>1"), lambda line: None)
    assert {"only-source==1.5", "deeper-source==1.5"} <= set(made.facts["packages"])
    assert {(one.name, one.version, one.sha256) for one in built} == {
        (name, "1.5", digest) for name, digest in hashes.items()
    }
    assert all(one.url.startswith("http") for one in built)
    assert not (tmp_path / "ran").exists()
    again = len(built)
    assert packages.HERE.make(request("only-source>1"), lambda line: None) == made
    assert len(built) == again


def test_what_is_named_beside_another_is_built_in_its_turn(
    index: Index, tmp_path: Path, built: list[Source]
) -> None:
    """uv names each package that lacks a wheel, also one of which only old releases do."""
    for name, version in (("half-source", "1.0"), ("half-source", "2.0"), ("deeper-source", "1.5")):
        source_distribution(index.folder, name, version, tmp_path / "ran")
    make_wheel(index.folder, "half-source", "2.0", requires=["deeper-source"])
    found = resolutions.resolution_for(request("half-source")).lock.packages
    assert {"half-source==2.0", "deeper-source==1.5"} <= set(found)
    assert "deeper-source" in {one.name for one in built}


def test_without_a_builder_there_are_wheels_alone(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing runs, and the text names the package; an older wheel rather than a newer source."""
    monkeypatch.setattr(resolutions, "BUILDER", None)
    monkeypatch.setattr(interpreters, "others", lambda declared, first: [])
    source_distribution(index.folder, "only-source", "1.5", tmp_path / "ran")
    with pytest.raises(ResolutionError, match=r"(?s)only-source.*wheels"):
        resolutions.resolution_for(request("only-source"))
    with pytest.raises(RequirementError, match="line 1 takes of-git from"):
        resolutions.resolution_for(request(f"of-git @ git+https://git.example/a/b@{COMMIT}"))
    source_distribution(index.folder, "some-wheel", "2.0", tmp_path / "ran")
    make_wheel(index.folder, "some-wheel", "1.0")
    assert "some-wheel==1.0" in resolutions.resolution_for(request("some-wheel")).lock.packages
    assert not (tmp_path / "ran").exists()


def test_a_repository_becomes_the_version_of_its_wheel(index: Index, built: list[Source]) -> None:
    make_wheel(index.folder, "only-wheel")
    line = f"Of_Git @ git+https://git.example/a/b.git@{COMMIT}#subdirectory=python"
    found = resolutions.resolution_for(request(line)).lock
    assert {"of-git==3.0", "only-wheel==1.0"} <= set(found.packages)
    assert built == [
        Source(
            "of-git",
            url="https://git.example/a/b.git",
            commit=COMMIT,
            subdirectory="python",
            where="line 1",
        )
    ]


@pytest.mark.parametrize(
    "url",
    [
        *("git+ssh://git.example/a@b", "git+https://git.example/a@", "git+file:///a@b"),
        *("git+https://user:secret@git.example/a@b", "git+https://git.example/a@b --x"),
        *("git+https://git.example/a@../b", "git+https://git.example/a@b#egg=x"),
        "https://git.example/a.tar.gz",
    ],
)
def test_nothing_else_is_a_repository(url: str) -> None:
    """No other protocol, no login, no option, and no empty revision."""
    with pytest.raises(RequirementError):
        parse_requirement(f"a @ {url}", "line 1")
    good = parse_requirement("a @ git+https://git.example/a", "line 1")
    assert of_git(good.requirement, "line 1") is not None
