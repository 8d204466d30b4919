"""Data that one stage of lockdown hands to the next: zygote to init, init to runner."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from envhub_worker.lockdown.mechanisms.mounts import View
from envhub_worker.lockdown.mechanisms.scratch import Scratch
from envhub_worker.lockdown.root_plan import RootPlan
from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.protocol.records import dataclass


@dataclass(frozen=True, kw_only=True)
class ZygoteConfig:
    """The configuration of a zygote.

    Attributes:
        parent: The server's pid.
        target: The function that a confined runner calls, as ``"module:function"``.
        gpu: Whether the jails get all GPUs, or the indices of their GPUs.
        packages: The folder of the jails' packages, symbolic links resolved, or empty. Not trusted:
            only a confined runner imports from it.
        place: An empty folder of the zygote's own.
        canary: A file that exists and that no jail may read.
        user: The user to become if the server is root, else None.
        record: Whether init answers denied system calls and reports them.
        refusal: Why jails are impossible here (``LayerUnavailableError.to_wire``), if known.
    """

    parent: int
    target: str
    profile: str
    network: str
    gpu: bool | tuple[int, ...]
    readable: tuple[str, ...]
    packages: str
    roots: tuple[str, ...]
    place: str
    canary: str
    user: int | None
    record: bool
    refusal: dict[str, str] | None

    @classmethod
    def from_wire(cls, data: dict[str, Any]) -> ZygoteConfig:
        """Rebuilds a configuration from its ``dataclasses.asdict`` form after JSON."""
        lists = {name: tuple(value) for name, value in data.items() if type(value) is list}
        return cls(**{**data, **lists})


@dataclass(frozen=True, kw_only=True)
class Common:
    """Data that a zygote hands to each of its inits.

    Attributes:
        pid: The zygote's pid, as an init sees its parent.
        root: The host's files that a jail sees, symbolic links resolved.
        covered: (files, folders) of /proc to hide.
        landlock_abi: The kernel's Landlock ABI; 0 without Landlock.
        brokered: Whether init sends the jails' signals.
        watched: Permitted calls that the kernel reports to init, so that init can record them.
        programs: The compiled system call filters: one for jails whose memory a control group
            counts, one for jails whose init measures it.
        set_blas_threads: Sets the number of OpenBLAS's threads, if numpy uses OpenBLAS.
    """

    config: ZygoteConfig
    pid: int
    namespaced: bool
    root: RootPlan
    covered: tuple[list[str], list[str]]
    landlock_abi: int
    brokered: bool
    watched: frozenset[str]
    programs: tuple[bytes, ...]
    set_blas_threads: Callable[[int], None] | None = None


@dataclass(frozen=True, kw_only=True)
class JailContext:
    """Data of an init that its runners need.

    Attributes:
        processes: Cap for ``RLIMIT_NPROC``.
        measured: Whether init measures memory because no control group counts it.
        joins: Descriptors of the files that a runner writes to join the jail's control group.
    """

    init: int
    spec: JailSpec
    common: Common
    scratch: Scratch
    view: View
    processes: int
    measured: bool
    joins: list[int]
