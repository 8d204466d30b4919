"""Learn where another process keeps what."""


def attack(pid):
    with open(f"/proc/{pid}/maps") as file:
        return file.read()
