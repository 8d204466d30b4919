"""Push an open file into the process at the other end of a socket that we were given."""

import os
import socket
import stat

kept = []


def attack(name, path):
    file = os.memfd_create(name)
    kept.append(file)
    sent = 0
    if path:
        peer = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        peer.connect(path)
        kept.append(peer)
    for fd in range(3, 256):
        try:
            if not stat.S_ISSOCK(os.fstat(fd).st_mode):
                continue
            with socket.socket(fileno=os.dup(fd)) as stream:
                socket.send_fds(stream, [b"\x01\0\0\0"], [file] * 8)
                sent += 1
        except OSError:
            continue
    return sent
