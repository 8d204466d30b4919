"""Run a program that belongs to another user and takes on its rights, and let it stand."""

import subprocess

kept = []


def attack(command, uid):
    user = {} if uid is None else {"user": uid}
    kept.append(
        subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            **user,
        )
    )
    return kept[-1].pid
