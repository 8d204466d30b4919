"""Connect to a TCP port and send a message."""

import socket


def attack(host, port, message):
    with socket.create_connection((host, port), timeout=5) as connection:
        connection.sendall(message.encode())
