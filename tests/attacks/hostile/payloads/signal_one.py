"""Send a signal to the client in each of the ways that there are."""

import fcntl
import os
import signal
import socket
import struct

from payloads.kernel import syscall


def attack(pid, way):
    if way == "kill":
        os.kill(pid, signal.SIGURG)
    elif way == "sigqueue":
        information = struct.pack("=iiii", signal.SIGURG, 0, -1, 0).ljust(128, b"\0")
        syscall("rt_sigqueueinfo", pid, signal.SIGURG, information)
    elif way == "pidfd":
        syscall("pidfd_send_signal", syscall("pidfd_open", pid, 0), signal.SIGURG, None, 0)
    else:
        ours, theirs = socket.socketpair()
        fcntl.fcntl(ours, fcntl.F_SETOWN, pid)
        fcntl.fcntl(ours, 10, signal.SIGURG)  # F_SETSIG
        fcntl.fcntl(ours, fcntl.F_SETFL, os.O_ASYNC)
        theirs.send(b"x")
