"""Connect by sending: no connect() is called that a filter could see."""

import socket


def attack(host, port, message):
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sender:
        sender.sendto(message.encode(), socket.MSG_FASTOPEN, (host, port))
