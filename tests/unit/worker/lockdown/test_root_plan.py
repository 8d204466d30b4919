"""What of the host's files a jail sees, over a host that is made up."""

import pytest

from envhub_worker.lockdown.root_plan import HostFiles, RootPlan, outermost, plan_root

FOLDERS = {
    *("/", "/usr", "/usr/bin", "/usr/lib", "/etc/fonts", "/opt/py", "/opt/py/lib", "/data/store"),
    *("/home/ann", "/home/ann/proj", "/sys/devices/system/cpu"),
}
FILES = {"/etc/ld.so.cache", "/etc/resolv.conf", "/etc/hosts"}
LINKS = {
    "/bin": "usr/bin",
    "/lib": "usr/lib",
    "/python": "/opt/py",
    "/opt/py/current": "lib",
    "/all": "home",
}
HOST = HostFiles(
    exists=lambda path: path in FOLDERS | FILES,
    readlink=LINKS.get,
    listdir=lambda path: [],
    read=lambda path: "",
)


def root(
    interpreter: tuple[str, ...] = (),
    readable: tuple[str, ...] = (),
    roots: tuple[str, ...] = (),
    *,
    devices: tuple[str, ...] = (),
    network: str = "none",
) -> RootPlan:
    return plan_root(
        interpreter,
        readable,
        roots,
        private=["/home/ann", "/run/envhub/zygote"],
        devices=devices,
        network=network,
        host=HOST,
    )


def test_root_without_wishes_is_the_system_only() -> None:
    """System folders, what libraries read of /etc, plain devices; links as links."""
    plan = root()
    assert plan.trees == ("/etc/fonts", "/sys/devices/system/cpu", "/usr")
    assert plan.copies == ("/etc/ld.so.cache",)
    assert plan.devices == ("/dev/null", "/dev/full", "/dev/random", "/dev/urandom", "/dev/tty")
    assert (plan.links["/bin"], plan.links["/lib"]) == ("usr/bin", "usr/lib")
    assert plan.links["/dev/fd"] == "/proc/self/fd"
    assert set(plan.texts) == {"/etc/passwd", "/etc/group", "/etc/nsswitch.conf", "/etc/hosts"}


def test_interpreter_appears_where_it_is() -> None:
    plan = root(interpreter=("/opt/py", "/opt/py/lib", "/python/current", "/usr/bin", "/nowhere"))
    assert plan.trees == ("/etc/fonts", "/opt/py", "/sys/devices/system/cpu", "/usr")
    assert plan.links["/python"] == "/opt/py"


@pytest.mark.parametrize("path", ["/", "/home", "/home/ann", "/run", "/run/envhub", "/all"])
def test_interpreter_cannot_open_a_home(path: str) -> None:
    """A sys.path entry at or above a home is left out, or one that leads there; a project below it
    is not."""
    assert root(interpreter=(path, "/home/ann/proj")).trees == (
        "/etc/fonts",
        "/home/ann/proj",
        "/sys/devices/system/cpu",
        "/usr",
    )


def test_caller_may_grant_what_it_likes() -> None:
    assert "/home/ann" in root(readable=("/home/ann",)).trees


def test_snapshot_roots_are_kept_apart() -> None:
    plan = root(roots=("/data/store",))
    assert plan.roots == ("/data/store",)
    assert "/data/store" not in plan.trees


def test_devices_are_those_that_are_granted() -> None:
    """With the harmless ones; never the one whose mappings are memory in no account."""
    plan = root(devices=("/dev/nvidia0",))
    assert plan.devices == (*root().devices, "/dev/nvidia0")
    assert "/dev/zero" not in plan.devices


def test_host_network_adds_name_resolution() -> None:
    plan = root(network="host")
    assert plan.copies == ("/etc/ld.so.cache", "/etc/resolv.conf", "/etc/hosts")
    assert "/etc/hosts" not in plan.texts


def test_outermost_keeps_no_path_within_another() -> None:
    assert outermost(["/a/b", "/a", "/ab", "/c/d", "/c/d/e"]) == ("/a", "/ab", "/c/d")
