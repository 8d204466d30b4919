"""Make a symbolic link to a file in the scratch folder and open that."""

import os
import tempfile


def attack(path):
    link = os.path.join(tempfile.mkdtemp(), "link")
    os.symlink(path, link)
    with open(link) as file:
        return file.read()
