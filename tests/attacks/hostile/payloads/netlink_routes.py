"""Ask the kernel for the host's network addresses over netlink."""

import socket
import struct


def attack():
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as asker:
        asker.bind((0, 0))
        asker.send(struct.pack("=IHHII4xIII", 32, 18, 0x301, 1, 0, 0, 0, 0))
        return asker.recv(1 << 16).hex()
