"""Where jails have no GPU, PyTorch comes without CUDA, if the index has it so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from envhub_sandbox.dependencies import resolve
from envhub_sandbox.dependencies.declared import parse_requirement
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.dependencies.resolutions import resolution_for
from envhub_sandbox.dependencies.resolve import Lock
from tests.support.packages.wheels import Index, make_wheel

TORCH = PackageRequest("requirements.txt", (parse_requirement("vision", "line 1"),))
CUDA = Lock("torch==2.5 \\\n    --hash=sha256:00\nnvidia-cublas==1 \\\n    --hash=sha256:00\n")


@pytest.fixture
def cuda(index: Index) -> Path:
    """An index whose torch needs packages of NVIDIA's."""
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


def test_an_index_without_stays_as_it_is(cuda: Path) -> None:
    make_wheel(cuda, "torch", "2.4+cpu")
    assert names(TORCH) == {"torch==2.5", "torchvision==0.20", "nvidia-cublas==1.0"}


@pytest.mark.parametrize("gpu", [True, False])
def test_who_has_a_gpu_gets_cuda(gpu: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a second look at the index; likewise who has told uv which build he wants."""
    lock = CUDA
    if not gpu:
        monkeypatch.setenv("UV_TORCH_BACKEND", "cu128")

    def resolved(*given: object) -> Lock:
        pytest.fail("the index was asked again")

    assert resolve.without_cuda(replace(TORCH, gpu=gpu), lock, resolved) is lock


def test_pytorchs_own_index_is_asked_only_by_who_has_chosen_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lock = CUDA
    without = Lock("torch==2.5+cpu \\\n    --hash=sha256:00\n")
    monkeypatch.delenv("UV_TORCH_BACKEND", raising=False)
    for chosen, asked in ((True, [()]), (False, [(), ("--torch-backend", "cpu")])):
        monkeypatch.setattr(
            "envhub_sandbox.dependencies.index.is_chosen", lambda chosen=chosen: chosen
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
