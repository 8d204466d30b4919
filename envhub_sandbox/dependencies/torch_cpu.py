"""PyTorch without CUDA, where jails have no GPU: a lock without NVIDIA's packages.

Which builds there are, only the index knows, and many mirrors have none of these: what cannot be
had is no error, and the versions that were chosen first stay.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from envhub_sandbox.dependencies import index
from envhub_sandbox.dependencies.declared import parse_requirement
from envhub_sandbox.dependencies.request import PackageRequest
from envhub_sandbox.dependencies.resolve import Lock
from envhub_sandbox.errors import DependencyError

_OF_TORCH = ("torch", "torchvision", "torchaudio")
_PYTORCHS_INDEX = ("--torch-backend", "cpu")
_CUDA = ("nvidia-", "cuda-")


def smaller(
    request: PackageRequest,
    lock: Lock,
    resolved: Callable[[PackageRequest, Sequence[str]], Lock],
) -> Lock:
    """The same without CUDA, if it is not needed and the index has that.

    Args:
        request: What is asked for.
        lock: Its versions.
        resolved: Gives versions for a request, with further options for uv.
    """
    if request.gpu or not _has_cuda(lock) or os.environ.get("UV_TORCH_BACKEND"):
        return lock
    for asked, options in _ways(request, lock):
        try:
            found = resolved(asked, options)
        except DependencyError:
            continue
        if not _has_cuda(found):
            return found
    return lock


def options_for(lock: Lock) -> tuple[str, ...]:
    """What uv needs to find these versions again, where only they are known."""
    pins = lock.packages
    without = any(pin.partition("==")[0] in _OF_TORCH and pin.endswith("+cpu") for pin in pins)
    return _PYTORCHS_INDEX if without and not index.is_chosen() else ()


def _has_cuda(lock: Lock) -> bool:
    pins = lock.packages
    return any(pin.startswith("torch==") for pin in pins) and any(
        pin.startswith(_CUDA) for pin in pins
    )


def _ways(request: PackageRequest, lock: Lock) -> Iterator[tuple[PackageRequest, Sequence[str]]]:
    """The same versions of the user's own index; and of PyTorch's, where he has chosen none."""
    rows = [pin.partition("==") for pin in lock.packages]
    held = tuple(
        parse_requirement(f"{name}=={version.partition('+')[0]}+cpu", "the choice of no CUDA")
        for name, _, version in rows
        if name in _OF_TORCH
    )
    yield replace(request, constraints=(*request.constraints, *held)), ()
    if not index.is_chosen():
        yield request, _PYTORCHS_INDEX
