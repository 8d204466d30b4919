"""Send a message to another process over netlink."""

import socket

_NETLINK_USERSOCK = 2


def attack(port, message):
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_USERSOCK) as sender:
        sender.sendto(message.encode(), (port, 0))
