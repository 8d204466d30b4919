"""Call parts of the kernel that a program of this kind never needs, with arguments that do nothing.

What comes back tells whether the call got there.
"""

import errno

from payloads.kernel import number, syscall


def attack(calls):
    answers = {}
    for name, arguments in calls.items():
        if number(name) is None:
            answers[name] = "not on this machine"
            continue
        try:
            answers[name] = str(syscall(name, *arguments))
        except OSError as error:
            answers[name] = errno.errorcode.get(error.errno, str(error.errno))
    return answers
