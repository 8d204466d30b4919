"""Write something private into this jail's own scratch folders; not an attack itself."""

import os
import tempfile


def attack(text):
    path = os.path.join(tempfile.mkdtemp(), "private")
    with open(path, "w") as file:
        file.write(text)
    return path
