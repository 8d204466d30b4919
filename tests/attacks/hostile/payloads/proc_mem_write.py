"""Write another process's memory as a file."""

import os


def attack(pid, address, message):
    fd = os.open(f"/proc/{pid}/mem", os.O_RDWR)
    os.pwrite(fd, message.encode(), address)
