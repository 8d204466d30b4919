"""A second host on this one: a network namespace of its own, and a cable to it."""

import os
import secrets
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest


def _run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)


@dataclass
class OtherHost:
    """The far end of a veth pair; the near one is here."""

    namespace: str
    device: str
    address: str
    prefix: tuple[str, ...]

    def unplug(self) -> None:
        """The cable is out: packets are lost, and nobody is told."""
        self._drop("-I")

    def plug(self) -> None:
        self._drop("-D")

    def _drop(self, how: str) -> None:
        for chain in ("INPUT", "OUTPUT"):
            done = _run(*self.prefix, "iptables", "-w", how, chain, "-j", "DROP")
            assert done.returncode == 0, done.stderr

    def disturb(self, delay_ms: int, loss_percent: int) -> str:
        """Delay and lose packets as far as this kernel can; says what it does."""
        netem = ("netem", "delay", f"{delay_ms}ms", "loss", f"{loss_percent}%")
        tc = ("tc", "qdisc", "add", "dev", self.device, "root")
        if _run(*tc, *netem).returncode == 0:
            return "delay and loss"
        rule = ("-m", "statistic", "--mode", "random", "--probability", str(loss_percent / 100))
        lossy = _run(*self.prefix, "iptables", "-w", "-A", "INPUT", *rule, "-j", "DROP")
        return "loss" if lossy.returncode == 0 else "nothing"


def missing() -> str:
    """What this machine lacks for another host, or nothing."""
    if os.getuid() != 0:
        return "network namespaces with a cable between them need root"
    lacks = [tool for tool in ("ip", "tc", "iptables", "nsenter") if shutil.which(tool) is None]
    return f"needs {', '.join(lacks)} (iproute2, iptables)" if lacks else ""


@contextmanager
def other_host() -> Iterator[OtherHost]:
    """A host that goes again, with everything on its end of the cable."""
    reason = missing()
    if reason:
        pytest.skip(reason)
    tag = secrets.token_hex(3)
    # others make hosts at the same time: each has a few addresses of many
    net, low = f"10.213.{secrets.randbelow(256)}", 4 * secrets.randbelow(64)
    ours, theirs = f"{net}.{low + 1}", f"{net}.{low + 2}"
    namespace, near, far = f"envhub-{tag}", f"eh{tag}a", f"eh{tag}b"
    try:
        for line in (
            f"ip netns add {namespace}",
            f"ip link add {near} type veth peer name {far} netns {namespace}",
            f"ip addr add {ours}/30 dev {near}",
            f"ip link set {near} up",
            f"ip -n {namespace} addr add {theirs}/30 dev {far}",
            f"ip -n {namespace} link set {far} up",
            f"ip -n {namespace} link set lo up",
        ):
            done = _run(*line.split())
            if done.returncode != 0:
                pytest.skip(f"cannot make another host ({line}): {done.stderr.strip()}")
        # not 'ip netns exec', which would hide the control groups
        prefix = ("nsenter", f"--net=/run/netns/{namespace}", "--")
        yield OtherHost(namespace, near, theirs, prefix)
    finally:
        _run("ip", "link", "del", near)
        _run("ip", "netns", "del", namespace)
