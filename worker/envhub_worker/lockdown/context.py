"""What the stages of lockdown hand down: zygote to init, init to runner."""

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
    """How a zygote is started.

    Attributes:
        parent: The server's pid.
        target: What a runner runs once it is confined, as ``"module:function"``.
        gpu: Whether they get all GPUs, or the indices of those that they get.
        packages: The folder of packages that their code comes with, symbolic links resolved, or
            empty. Not trusted: only a runner imports from it, once it is confined.
        place: An empty folder of the zygote's own.
        canary: A file that exists and that no jail may read.
        user: The user to become where the server is root, else None.
        record: Whether init answers what the filter denies, and tells.
        refusal: Why no jail can be had (``LayerUnavailableError.to_wire``), if that is known.
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
        """From ``dataclasses.asdict`` after a trip through JSON."""
        lists = {name: tuple(value) for name, value in data.items() if type(value) is list}
        return cls(**{**data, **lists})


@dataclass(frozen=True, kw_only=True)
class Common:
    """What a zygote hands to each of its inits.

    Attributes:
        pid: The zygote's pid as an init sees it as its parent.
        root: What a jail sees of the host's files, symbolic links resolved.
        covered: (files, folders) of /proc to hide.
        landlock_abi: 0 where there is none.
        brokered: Whether init sends the jails' signals.
        watched: Permitted calls that init is notified of, so that it can record them.
        programs: The compiled system call filters: one for jails whose memory a control group
            counts, one for jails whose init measures it.
        set_blas_threads: Sets OpenBLAS's threads, if that is what numpy uses.
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
    """What init knows and its runners need.

    Attributes:
        processes: Cap for ``RLIMIT_NPROC``.
        measured: Init measures memory, because no control group counts it.
        joins: Descriptors to write to in order to join the jail's control group, if it has one.
    """

    init: int
    spec: JailSpec
    common: Common
    scratch: Scratch
    view: View
    processes: int
    measured: bool
    joins: list[int]


@dataclass(frozen=True, kw_only=True)
class OwnPaths:
    """The paths that a jail's processes may use.

    Attributes:
        changed: Folders and files that they may change.
        read: Those that they may read.
        scratch: Folders in which they may have created symbolic links.
    """

    changed: tuple[str, ...] = ()
    read: tuple[str, ...] = ()
    scratch: tuple[str, ...] = ()
