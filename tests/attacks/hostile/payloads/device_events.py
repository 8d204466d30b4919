"""Wait for the kernel's events of the host's devices."""

import contextlib
import socket
import time

_UEVENT = 15


def attack(group, seconds):
    heard = []
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _UEVENT) as ear:
        ear.bind((0, group))
        ear.settimeout(0.2)
        until = time.monotonic() + seconds
        while time.monotonic() < until and not heard:
            with contextlib.suppress(TimeoutError):
                heard.append(ear.recv(1 << 16).decode(errors="replace"))
    return heard
