"""Connect to a socket file, as one does to docker, an ssh agent or a desktop's bus."""

import socket


def attack(path, message):
    address = "\0" + path[1:] if path.startswith("@") else path
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sender:
        sender.settimeout(5)
        sender.connect(address)
        sender.sendall(message.encode())
