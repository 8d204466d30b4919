"""Make a socket of a family that few need and that is a way into the kernel, and keep it."""

import socket

kept = []


def attack(family, kind, protocol):
    kept.append(socket.socket(family, kind, protocol))
