"""Put a frame of our own making on a network device."""

import socket


def attack(device, message):
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as sender:
        sender.bind((device, 0x88B5))
        sender.send(b"\0" * 12 + b"\x88\xb5" + message.encode())
