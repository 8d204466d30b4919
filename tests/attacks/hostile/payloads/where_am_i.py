"""Where this process finds itself; not an attack."""

import os


def attack():
    here = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    return {"root": here, "cwd": os.getcwd(), "home": os.environ["HOME"], "pid": os.getpid()}
