"""Change a file: append to it, or put another in its place."""

import os


def attack(path, text):
    errors = []
    for change in (_make_writable, _append, _replace, _truncate):
        try:
            change(path, text)
        except OSError as error:
            errors.append(f"{change.__name__}: {error}")
    return errors


def _make_writable(path, text):
    folder = os.path.dirname(path)
    os.chmod(folder, os.stat(folder).st_mode | 0o777)  # /tmp keeps its sticky bit
    os.chmod(path, 0o666)


def _append(path, text):
    with open(path, "a") as file:
        file.write(text)


def _replace(path, text):
    with open(path + ".new", "w") as file:
        file.write(text)
    os.replace(path + ".new", path)


def _truncate(path, text):
    os.truncate(path, 1)
