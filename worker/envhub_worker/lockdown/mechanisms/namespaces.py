"""User, pid, mount, network, IPC, UTS and cgroup namespaces."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import signal
import socket
import struct
from collections.abc import Callable

from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.mechanisms import kernel, process, procfs
from envhub_worker.protocol.text import shortage

#: The user that a jail sees itself as. Not 0: programs treat that one specially.
INSIDE_UID = 1000

#: The most that a TCP socket buffers in each direction, where the network is the jail's own.
TCP_BUFFER = 128 * 1024

_SIOCGIFFLAGS = 0x8913
_SIOCSIFFLAGS = 0x8914
_IFF_UP = 1

_WEAKER = 'Or choose a weaker one by its name: profile "no-userns".'


def enter_user_namespace(uid: int, gid: int) -> None:
    """Become ``INSIDE_UID`` of a new user namespace, with every capability over it.
    Raises ``LayerUnavailableError``: the host forbids it; the fix is for this host.
    """
    try:
        kernel.unshare(kernel.CLONE_NEWUSER)
        # Without this the kernel refuses to write gid_map: to leave a group that takes rights away
        # would add rights.
        _write("/proc/self/setgroups", "deny")
        _write("/proc/self/uid_map", f"{INSIDE_UID} {uid} 1")
        _write("/proc/self/gid_map", f"{INSIDE_UID} {gid} 1")
    except OSError as error:
        raise user_namespace_unavailable(error) from error


def _write(path: str, text: str) -> None:
    with open(path, "w") as file:
        file.write(text)


def mapped_to(user: int) -> int:
    """Returns a descriptor of a user namespace for mounts that map root's files to ``user``. Needs
    root.
    """
    parent = os.getpid()
    pid = os.fork()
    if pid == 0:
        process.die_with_parent(parent)
        with contextlib.suppress(OSError):
            kernel.unshare(kernel.CLONE_NEWUSER)
        # It only lends its namespace: it waits until the parent, who may map any user, has written
        # the map and holds a descriptor, and is then killed.
        signal.raise_signal(signal.SIGSTOP)
    try:
        os.waitpid(pid, os.WUNTRACED)
        for name in ("uid_map", "gid_map"):
            _write(f"/proc/{pid}/{name}", f"0 {user} 1")
        return os.open(f"/proc/{pid}/ns/user", os.O_RDONLY | os.O_CLOEXEC)
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def unshare_for_zygote(network: str) -> None:
    """Enter the namespaces that all jails of a zygote share."""
    flags = kernel.CLONE_NEWNS | kernel.CLONE_NEWPID | kernel.CLONE_NEWIPC | kernel.CLONE_NEWUTS
    _unshare(flags | (0 if network == "host" else kernel.CLONE_NEWNET))
    socket.sethostname("sandbox")


def unshare_for_jail(network: str) -> None:
    """Enter a jail's own namespaces, except the pid namespace, which its fork has made."""
    flags = kernel.CLONE_NEWNS | kernel.CLONE_NEWIPC | kernel.CLONE_NEWCGROUP
    _unshare(flags | (0 if network == "host" else kernel.CLONE_NEWNET))


def _unshare(flags: int) -> None:
    try:
        kernel.unshare(flags)
    except OSError as error:
        reason = f"unshare({flags:#x}) answers {os.strerror(error.errno or 0)}"
        raise LayerUnavailableError("namespaces", reason, _WEAKER) from error


def fork_in_new_pid_namespace() -> int:
    """``os.fork()`` whose child is the first process of a new pid namespace.

    The zygote must own its own pid namespace, or the kernel would not let it return there.
    """
    kernel.unshare(kernel.CLONE_NEWPID)
    pid = os.fork()
    if pid:
        # The kernel makes a pid namespace only below the caller's own. Without the way back every
        # later jail would be refused.
        back = os.pidfd_open(os.getpid())
        kernel.setns(back, kernel.CLONE_NEWPID)
        os.close(back)
    return pid


def forbid_what_is_counted() -> None:
    """Set this user namespace's limits on namespaces and file watches to 0, as a second barrier.

    The kernel counts them per user in each user namespace and in all above it, so a jail would take
    them from the user's other programs.
    """
    for name in os.listdir("/proc/sys/user"):
        _write(f"/proc/sys/user/{name}", "0")


def shrink_tcp() -> None:
    """Limit the buffers of a connection in our own network namespace to ``TCP_BUFFER``."""
    for name in ("tcp_rmem", "tcp_wmem"):
        with contextlib.suppress(FileNotFoundError):
            _write(f"/proc/sys/net/ipv4/{name}", f"4096 65536 {TCP_BUFFER}")


def raise_loopback() -> None:
    """Bring up the loopback device of our own network namespace."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as control:
        request = struct.pack("16sh22x", b"lo", 0)
        answer = fcntl.ioctl(control, _SIOCGIFFLAGS, request)
        flags = struct.unpack_from("16sh", answer)[1]
        fcntl.ioctl(control, _SIOCSIFFLAGS, struct.pack("16sh22x", b"lo", flags | _IFF_UP))


def user_namespace_unavailable(
    error: OSError, read: Callable[[str], str | None] = procfs.text
) -> LayerUnavailableError:
    """Returns the error that says why this host refused a user namespace, and how to permit it.
    ``read``: returns the text of a sysctl file, or None without that file.
    """
    reason, fix = _diagnosis(error, read)
    return LayerUnavailableError("user-namespace", reason, f"{fix} {_WEAKER}")


def _diagnosis(error: OSError, read: Callable[[str], str | None]) -> tuple[str, str]:
    if read("/proc/sys/user/max_user_namespaces") == "0":  # the kernel answers ENOSPC then
        return "user.max_user_namespaces is 0", "Run: sudo sysctl user.max_user_namespaces=15000."
    if read("/proc/sys/kernel/unprivileged_userns_clone") == "0":
        return (
            "kernel.unprivileged_userns_clone is 0",
            "Run: sudo sysctl kernel.unprivileged_userns_clone=1.",
        )
    if read("/proc/sys/kernel/apparmor_restrict_unprivileged_userns") == "1":
        return (
            "AppArmor restricts unprivileged user namespaces (Ubuntu 23.10 and later)",
            "Install the AppArmor profile that `envhub doctor` prints, or run: "
            "sudo sysctl kernel.apparmor_restrict_unprivileged_userns=0.",
        )
    if error.errno == errno.EAGAIN:
        limits = "ulimit -u; of a service TasksMax=; of a container its pids"
        return "a limit on processes and threads is reached", f"Raise it ({limits})."
    # ENOSPC also means that there are too many namespaces already.
    short, _, cure = shortage(error, "here").partition(": ")
    if short and error.errno != errno.ENOSPC:
        return short, f"{cure.capitalize()}."
    answer = errno.errorcode.get(error.errno or 0, "?")
    if read("/.dockerenv") is not None or read("/run/.containerenv") is not None:
        return (
            f"the container's seccomp profile forbids it ({answer})",
            "Lock the container itself down (--network none --read-only --cap-drop ALL "
            "--security-opt no-new-privileges --pids-limit 512 --memory 8g) and choose "
            'profile "container".',
        )
    return f"the kernel answers {answer}", "Ask the administrator of this host to allow it."
