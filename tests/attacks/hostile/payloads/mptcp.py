"""Connect with multipath TCP, which rules about TCP do not see."""

import socket

_IPPROTO_MPTCP = 262


def attack(host, port, message):
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM, _IPPROTO_MPTCP) as sender:
        sender.connect((host, port))
        sender.sendall(message.encode())
