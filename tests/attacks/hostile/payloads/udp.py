"""Send a datagram, to a connected and to an unconnected socket."""

import socket


def attack(host, port, message):
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as sender:
        sender.sendto(message.encode(), (host, port))
        sender.connect((host, port))
        sender.send(message.encode())
