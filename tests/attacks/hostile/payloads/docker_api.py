"""Ask the container engine of the host who it is; whoever may ask that may become root there."""

import socket


def attack(path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as engine:
        engine.settimeout(5)
        engine.connect(path)
        engine.sendall(b"GET /info HTTP/1.0\r\n\r\n")
        return b"".join(iter(lambda: engine.recv(65536), b"")).decode("utf-8", "replace")
