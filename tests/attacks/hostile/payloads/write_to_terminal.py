"""Write to the terminal that the client was started from."""

import os


def attack(text, ways):
    errors = []
    for way in ways:
        try:
            fd = os.open(way, os.O_WRONLY | os.O_NOCTTY)
            os.write(fd, text.encode())
            return "written"
        except OSError as error:
            errors.append(str(error))
    return errors
