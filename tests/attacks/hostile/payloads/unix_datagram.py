"""Send a datagram to a socket file, as one does to the system's log."""

import socket


def attack(path, message):
    address = "\0" + path[1:] if path.startswith("@") else path
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.sendto(message.encode(), address)
