"""Send a message over a VM socket."""

import socket


def attack(cid, port, message):
    with socket.socket(socket.AF_VSOCK, socket.SOCK_STREAM) as sender:
        sender.settimeout(5)
        sender.connect((cid, port))
        sender.sendall(message.encode())
