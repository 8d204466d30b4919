"""Where there is no wheel: what is chosen is handed to a builder, and its wheel counts then."""

import hashlib
import io
import tarfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages import interpreters, packages
from envhub_sandbox.extras.packages.declared import Source, of_git, parse_requirement
from envhub_sandbox.extras.packages.interpreters import Interpreter
from envhub_sandbox.extras.packages.request import PackageRequest
from envhub_sandbox.extras.packages.resolution import resolutions, resolve
from envhub_sandbox.extras.packages.resolution.pylock import Lock
from envhub_sandbox.extras.packages.resolution.resolutions import resolution_for
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import Index, locked, make_wheel

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


def test_only_the_builder_takes_sources(index: Index, tmp_path: Path, built: list[Source]) -> None:
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


def test_what_is_named_is_built_in_turn(index: Index, tmp_path: Path, built: list[Source]) -> None:
    """uv names each package that lacks a wheel, also one of which only old releases do."""
    for name, version in (("half-source", "1.0"), ("half-source", "2.0"), ("deeper-source", "1.5")):
        source_distribution(index.folder, name, version, tmp_path / "ran")
    make_wheel(index.folder, "half-source", "2.0", requires=["deeper-source"])
    found = resolutions.resolution_for(request("half-source")).lock.packages
    assert {"half-source==2.0", "deeper-source==1.5"} <= set(found)
    assert "deeper-source" in {one.name for one in built}


def test_two_packages_without_wheels_in_one_file(
    index: Index, tmp_path: Path, built: list[Source], monkeypatch: pytest.MonkeyPatch
) -> None:
    """uv names one at a time, and chooses no versions as long as another has none. Each costs a
    resolution, so there is an end to it, before anything is built."""
    for name in ("only-source", "deeper-source", "third-source"):
        source_distribution(index.folder, name, "1.5", tmp_path / "ran")
    with monkeypatch.context() as patch, refused_dependency("resolution", match="wheels"):
        patch.setattr(resolve, "MOST_SOURCES", 1)
        resolution_for(request("third-source==1.5", "only-source==1.5"))
    assert not built
    found = resolution_for(request("third-source==1.5", "only-source==1.5")).lock.packages
    assert {"only-source==1.5", "deeper-source==1.5", "third-source==1.5"} <= set(found)
    assert len(built) == len({one.name for one in built})


def test_what_is_named_is_as_new_as_pip_has_it(
    index: Index, tmp_path: Path, built: list[Source], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is built if only older releases have wheels, and no bound or date keeps the newest away.
    What others need has a wheel if it can. Where the build fails, the older one stays."""
    for name in ("half-source", "needed", "only-wheel"):
        make_wheel(index.folder, name, "1.0", requires=["needed"] * (name == "half-source"))
    for name in ("half-source", "needed", "deeper-source"):
        source_distribution(index.folder, name, "2.0", tmp_path / "ran")
    found = resolution_for(request("only-wheel", "half-source>=1")).lock.packages
    assert {"half-source==2.0", "deeper-source==2.0"} <= set(found)
    assert [one.name for one in built] == ["half-source", "deeper-source"]
    found = resolution_for(request("only-wheel", "half-source<2")).lock.packages
    assert {"half-source==1.0", "needed==1.0"} <= set(found)
    dated = replace(request("half-source"), exclude_newer="2020-01-01")
    index.uploaded |= {path.name: "2019-01-01" for path in index.folder.iterdir()}
    index.uploaded["half_source-2.0.tar.gz"] = "2021-01-01"
    assert "half-source==1.0" in resolution_for(dated).lock.packages

    def fails(*given: object) -> list[Path]:
        raise DependencyError("it needs gcc", reason="resolution")

    monkeypatch.setattr(resolutions, "BUILDER", fails)
    with pytest.warns(UserWarning, match=r"^half-source==1.0 is installed, .* it needs gcc"):
        found = resolution_for(request("only-wheel", "half-source")).lock.packages
    assert "half-source==1.0" in found


def test_without_a_builder_there_are_wheels_alone(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing runs, and the text names the package; an older wheel rather than a newer source."""
    monkeypatch.setattr(resolutions, "BUILDER", None)
    monkeypatch.setattr(interpreters, "others", lambda declared, first: [])
    source_distribution(index.folder, "only-source", "1.5", tmp_path / "ran")
    with refused_dependency("resolution", match=r"(?s)only-source.*wheels"):
        resolutions.resolution_for(request("only-source"))
    with refused_dependency("requirement", match="line 1 takes of-git from"):
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
    with refused_dependency("requirement"):
        parse_requirement(f"a @ {url}", "line 1")
    good = parse_requirement("a @ git+https://git.example/a", "line 1")
    assert of_git(good.requirement, "line 1") is not None


# --- Where jails have no GPU, PyTorch comes without CUDA, if the index has it so


TORCH = PackageRequest("requirements.txt", (parse_requirement("vision", "line 1"),))
CUDA = locked("torch==2.5", "nvidia-cublas==1")


@pytest.fixture
def cuda(index: Index) -> Path:
    make_wheel(index.folder, "vision", requires=["torch", "torchvision"])
    make_wheel(index.folder, "torch", "2.5", requires=["nvidia-cublas"])
    make_wheel(index.folder, "torchvision", "0.20", requires=["torch==2.5"])
    make_wheel(index.folder, "nvidia-cublas")
    return index.folder


def names(request: PackageRequest) -> set[str]:
    return set(resolution_for(request).lock.packages) & {
        *("torch==2.5", "torch==2.5+cpu", "torchvision==0.20", "torchvision==0.20+cpu"),
        "nvidia-cublas==1.0",
    }


def test_an_index_that_has_both(cuda: Path) -> None:
    make_wheel(cuda, "torch", "2.5+cpu")
    make_wheel(cuda, "torchvision", "0.20+cpu", requires=["torch==2.5"])
    assert names(TORCH) == {"torch==2.5+cpu", "torchvision==0.20+cpu"}


def test_an_index_without_stays_as_it_is(cuda: Path, index: Index) -> None:
    make_wheel(cuda, "torch", "2.4+cpu")
    index.uploaded["torch-2.5-py3-none-any.whl"] = "2026-01-01"
    assert names(TORCH) == {"torch==2.5", "torchvision==0.20", "nvidia-cublas==1.0"}
    with pytest.warns(UserWarning, match=r"CUDA \([\d.]+ KiB of downloads\).*UV_TORCH_BACKEND=cpu"):
        packages.HERE.make(TORCH, lambda line: None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        packages.HERE.make(TORCH, lambda line: None)


@pytest.mark.parametrize("gpu", [True, False])
def test_who_has_a_gpu_gets_cuda(gpu: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    lock = CUDA
    if not gpu:
        monkeypatch.setenv("UV_TORCH_BACKEND", "cu128")

    def resolved(*given: object) -> Lock:
        pytest.fail("the index was asked again")

    assert resolve.without_cuda(replace(TORCH, gpu=gpu), lock, resolved) is lock


def test_pytorchs_index_is_asked_only_if_none_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    lock = CUDA
    without = locked("torch==2.5+cpu")
    monkeypatch.delenv("UV_TORCH_BACKEND", raising=False)
    for chosen, asked in ((True, [()]), (False, [(), ("--torch-backend", "cpu")])):
        monkeypatch.setattr(
            "envhub_sandbox.extras.packages.resolution.index.is_chosen",
            lambda chosen=chosen: chosen,
        )
        given: list[object] = []

        def resolved(request: PackageRequest, options: object, given: list[object] = given) -> Lock:
            given.append(options)
            return without if options else lock

        assert resolve.without_cuda(TORCH, lock, resolved) is (lock if chosen else without)
        assert given == asked
        # a lock file has versions alone
        assert resolve.torch_options(without) == (() if chosen else ("--torch-backend", "cpu"))
        assert resolve.torch_options(lock) == ()
