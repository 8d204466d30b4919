"""Open a file by its path."""


def attack(path):
    with open(path, "rb") as file:
        return file.read(65536).decode("utf-8", "replace")
