"""From policy and host to layers, by exact output."""

import errno
import resource
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.mechanisms import landlock
from envhub_worker.lockdown.mechanisms.landlock import Ruleset
from envhub_worker.lockdown.mechanisms.mounts import View
from envhub_worker.lockdown.mechanisms.namespaces import user_namespace_unavailable
from envhub_worker.lockdown.mechanisms.scratch import Scratch
from envhub_worker.lockdown.plan import plan
from envhub_worker.lockdown.stages.runner import resource_limits, rules
from envhub_worker.protocol.confinement import GIB, MIB, Confinement, Limits

USER = {"machine": "x86_64", "root": False, "landlock_abi": 7, "memory": "watchdog"}
STRICT = Confinement(limits=Limits(memory_bytes=GIB, disk_bytes=64 * MIB, disk_files=10))


def layers(confinement: Confinement, facts: dict[str, Any]) -> list[tuple[str, bool, str]]:
    made = plan(confinement, **facts)
    return [(layer.layer, layer.enforced, layer.detail) for layer in made]


def test_strict_as_a_user_has_every_layer() -> None:
    assert layers(STRICT, USER) == [
        ("user-namespace", True, "one user, without capabilities outside"),
        ("pid-namespace", True, "sees and signals only its own processes"),
        ("mount-namespace", True, "a private read-only root; other files do not exist"),
        ("scratch", True, "one tmpfs of 64 MiB and 10 files"),
        ("network-namespace", True, "no active device"),
        ("ipc-namespace", True, "its own System V and POSIX objects"),
        ("uts-namespace", True, "a neutral host name"),
        ("cgroup-namespace", True, "its own view of control groups"),
        ("capabilities", True, "none in any set"),
        ("no-new-privileges", True, "no rights from set-user-id programs"),
        ("landlock", True, "ABI 7: files, TCP, signals and abstract sockets"),
        ("seccomp", True, "allow-list for x86_64"),
        ("rlimits", True, "512 processes, 1024 open files, no core dumps"),
        (
            "memory",
            True,
            "1024 MiB, measured by the jail's init; bursts between two looks overshoot; "
            "not counted: file locks, epoll watches",
        ),
        (
            "user-quotas",
            False,
            "shared with this user's programs: pages of pipes, descriptors in flight in sockets, "
            "epoll watches; jails of root, or of a user who runs nothing else, have their own",
        ),
    ]


def test_root_becomes_somebody_else_first() -> None:
    """The first layer as root; memory by control group where there is one."""
    made = layers(STRICT, {**USER, "root": True, "memory": "cgroup-v1"})
    assert made[0] == ("unprivileged-user", True, "a user id without files and processes")
    assert made[-2:] == [
        ("memory", True, "1024 MiB, counted by the kernel (cgroup v1); not counted: file locks"),
        ("user-quotas", True, "its own: no other program runs as this user"),
    ]


def test_memory_that_nobody_counts_is_named() -> None:
    for profile, network, names in (
        ("strict", "host", "file locks, epoll watches, buffers of network connections"),
        ("no-userns", "none", "file locks, epoll watches, sockets that wait in sockets"),
    ):
        made = layers(replace(STRICT, profile=profile, network=network), USER)
        [detail] = [detail for layer, _, detail in made if layer == "memory"]
        assert detail.endswith(f"not counted: {names}")


def test_weaker_profile_lists_what_it_goes_without() -> None:
    made = layers(replace(STRICT, profile="no-userns"), USER)
    why = "the profile no-userns goes without"
    assert made[:3] == [
        ("pid-namespace", False, f"{why}: processes of the host are visible"),
        ("mount-namespace", False, f"{why}: names and sizes of the host's files are visible"),
        ("network", True, "only connected local socket pairs"),
    ]
    assert made[-1] == ("scratch", True, "64 MiB, measured by the jail's init")


@pytest.mark.parametrize("gpu", [True, (0,)])
def test_what_a_gpu_keeps_from_being_counted_is_told(gpu: bool | tuple[int, ...]) -> None:
    for memory, more in (("cgroup-v2", ""), ("watchdog", ", epoll watches, memfds and shared")):
        made = layers(replace(STRICT, gpu=gpu), {**USER, "memory": memory})
        [detail] = [detail for layer, _, detail in made if layer == "memory"]
        assert f"; not counted: file locks, memory of the GPU's driver{more}" in detail


def test_network_is_reported_as_chosen() -> None:
    for network, enforced, detail in (
        ("loopback", True, "only a loopback device"),
        ("host", False, "the host's network, by explicit choice"),
    ):
        made = layers(replace(STRICT, network=network), USER)
        assert ("network-namespace", enforced, detail) in made


@pytest.mark.parametrize(
    ("confinement", "facts", "layer"),
    [
        (STRICT, {**USER, "landlock_abi": 0}, "landlock"),
        (replace(STRICT, profile="no-userns"), {**USER, "landlock_abi": 2}, "landlock"),
        (replace(STRICT, profile="no-userns", network="loopback"), USER, "network-namespace"),
        (replace(STRICT, profile="container", network="loopback"), USER, "network-namespace"),
        (replace(STRICT, profile="no-userns", display="virtual"), USER, "display"),
        (STRICT, {**USER, "machine": "riscv64"}, "seccomp"),
        (replace(STRICT, profile="lax"), USER, "profile"),
        (replace(STRICT, network="lan"), USER, "network"),
    ],
)
def test_missing_layer_has_fix(confinement: Confinement, facts: dict[str, Any], layer: str) -> None:
    with pytest.raises(LayerUnavailableError) as raised:
        plan(confinement, **facts)
    assert raised.value.layer == layer
    assert raised.value.reason
    assert raised.value.fix


def test_signals_are_a_layer_where_init_must_send_them() -> None:
    bare = replace(STRICT, profile="no-userns")
    signals = ("signals", True, "sent by the jail's init, to processes of the jail only")
    assert signals in layers(bare, {**USER, "landlock_abi": 4})
    assert signals not in layers(bare, {**USER, "landlock_abi": 6})
    assert signals not in layers(STRICT, {**USER, "landlock_abi": 4})


def test_container_without_landlock_says_so() -> None:
    container = replace(STRICT, profile="container")
    assert ("landlock", False, "this kernel or container has none") in layers(
        container, {**USER, "landlock_abi": 0}
    )


@pytest.mark.parametrize(
    ("abi", "network", "wanted"),
    [
        *((abi, "none", Ruleset(2**bits - 1, 0, 0)) for abi, bits in ((1, 13), (2, 14), (3, 15))),
        *((abi, "none", Ruleset(2**bits - 1, 3, 0)) for abi, bits in ((4, 15), (5, 16))),
        *((abi, "none", Ruleset(2**16 - 1, 3, 3)) for abi in (6, 9)),
        *((7, network, Ruleset(2**16 - 1, 0, 3)) for network in ("loopback", "host")),
    ],
)
def test_landlock_asks_for_what_the_abi_knows(abi: int, network: str, wanted: Ruleset) -> None:
    """An unknown bit would be EINVAL; a newer kernel than we know gets all we know."""
    assert landlock.ruleset(abi, network) == wanted


def test_landlock_write_includes_neither_devices_nor_more_than_abi_one_to_five() -> None:
    """Scratch takes files, folders, links, fifos and sockets; never a device node."""
    assert landlock.WRITE & (landlock.MAKE_CHAR | landlock.MAKE_BLOCK | landlock.IOCTL_DEV) == 0
    assert landlock.WRITE < 2**16
    assert landlock.READ == landlock.EXECUTE | landlock.READ_FILE | landlock.READ_DIR


@pytest.mark.parametrize("namespaced", [True, False])
@pytest.mark.parametrize("gpu", [False, (0,)])
def test_only_the_scratch_can_be_written(gpu: bool | tuple[int, ...], namespaced: bool) -> None:
    """And to devices; with a GPU also the names of threads. Of processes a jail reads its own."""
    jail: Any = SimpleNamespace(
        common=SimpleNamespace(
            root=SimpleNamespace(trees=("/usr",), devices=("/dev/null",)),
            namespaced=namespaced,
            config=SimpleNamespace(gpu=gpu),
        ),
        spec=SimpleNamespace(snapshot="/snapshot"),
        scratch=Scratch.on_host("/jail"),
        view=View({}, {"/snapshot": "no overlay"}),
    )
    permitted = {(rule.path, rule.access) for rule in rules(jail, 7)}
    written = {(path, access) for path, access in permitted if access & ~landlock.READ}
    scratch = {(f"/jail/{name}", landlock.WRITE) for name in ("home", "tmp", "work")}
    threads = ("/proc" if namespaced else "/proc/7/task", landlock.WRITE_FILE | landlock.TRUNCATE)
    devices = {"/dev/null", "/dev/pts"} if namespaced else {"/dev/null"}
    assert written - scratch == {
        *((path, landlock.DEVICE) for path in devices),
        *([threads] if gpu else []),
    }
    shared = {"/", "/etc", "/proc", "/sys", "/dev", "/run"} & {path for path, _ in permitted}
    assert shared == ({"/etc", "/proc", "/dev"} if namespaced else set())
    assert namespaced or ("/proc/7", landlock.READ_DIR) in permitted


def test_rlimits_follow_the_limits() -> None:
    limits = Limits(open_files=9, disk_bytes=77, cpu_time_s=5)
    assert resource_limits(limits, 12) == {
        resource.RLIMIT_CORE: (0, 0),
        resource.RLIMIT_FSIZE: (77, 77),
        resource.RLIMIT_NOFILE: (9, 9),
        resource.RLIMIT_MEMLOCK: (65536, 65536),
        resource.RLIMIT_MSGQUEUE: (0, 0),
        resource.RLIMIT_NICE: (0, 0),
        resource.RLIMIT_RTPRIO: (0, 0),
        resource.RLIMIT_SIGPENDING: (512, 512),
        resource.RLIMIT_NPROC: (12, 12),
        resource.RLIMIT_CPU: (5, 6),
    }


@pytest.mark.parametrize(
    ("files", "reason", "fix"),
    [
        ({"/proc/sys/user/max_user_namespaces": "0"}, "is 0", "user.max_user_namespaces=15000"),
        (
            {"/proc/sys/kernel/unprivileged_userns_clone": "0"},
            "unprivileged_userns_clone is 0",
            "sudo sysctl kernel.unprivileged_userns_clone=1",
        ),
        (
            {"/proc/sys/kernel/apparmor_restrict_unprivileged_userns": "1"},
            "AppArmor",
            "sudo sysctl kernel.apparmor_restrict_unprivileged_userns=0",
        ),
        ({"/.dockerenv": ""}, "container's seccomp profile", 'profile "container"'),
        ({}, "EPERM", "administrator"),
        ({}, "limit on processes", "ulimit -u"),
    ],
)
def test_refused_user_namespace_is_explained(files: dict[str, str], reason: str, fix: str) -> None:
    number = errno.EAGAIN if "ulimit" in fix else errno.EPERM
    error = user_namespace_unavailable(OSError(number, "no"), files.get)
    assert error.layer == "user-namespace"
    assert reason in error.reason
    assert fix in error.fix
    assert 'by its name: profile "no-userns"' in error.fix
