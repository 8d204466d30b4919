"""Send a datagram to a socket file from half of a socket pair: socket() is never called."""

import socket


def attack(path, message):
    ours, _ = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        ours.sendto(message.encode(), path)
    except OSError:
        ours.sendmsg([message.encode()], [], 0, path)
