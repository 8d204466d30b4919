"""A file that is named alone, beside what is its user's: what its code gets of that folder.
The control is Python on the same file, where it lies. Whether something was stolen says a random
token in what comes back."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from envhub_sandbox import make_env
from tests.attacks.files.test_reads import secret_file
from tests.attacks.harness import TIMEOUTS, Arena, token
from tests.support.repositories import STILL

FAMILY = "A file among others"
LOOKS = f"""{STILL}
import glob, importlib, os, pkgutil
from pathlib import Path
try:
    import linked  # a link to tax.txt
except Exception as error:
    linked = error
try:
    import taxes, taxes.of_2025  # a folder of documents
except Exception as error:
    taxes = error
HERE = Path(__file__).resolve().parent

def tried(function, *arguments):
    try:
        return repr(function(*arguments))
    except BaseException as error:
        return repr(error)

def walked(top):
    return [(one, files, [tried((Path(one) / file).read_text) for file in files])
            for one, _, files in os.walk(top)]

class Looks(Still):
    def look(self):
        names = (".ssh/id_rsa", ".env", "tax.txt", "taxes/return.txt", "private.py")
        read = [tried(Path(top, name).read_text) for name in names for top in (HERE, ".", "/repo")]
        found = [tried(walked, top) for top in (HERE, HERE.parent, ".")]
        modules = [tried(lambda: vars(importlib.import_module("pri" + "vate")))]
        modules += [tried(lambda: [one.name for one in pkgutil.iter_modules([str(HERE)])])]
        return [read, found, modules, glob.glob(str(HERE / "**"), recursive=True), repr(linked),
                tried(os.listdir, HERE)]
"""
PLANTED: dict[str, Callable[[Path], object]] = {
    "": lambda folder: None,
    ", and brings a link": lambda folder: (folder / "linked.py").symlink_to("tax.txt"),
    ", and brings a package with a link to its folder": lambda folder: (
        (folder / "linked").mkdir(),
        (folder / "linked/__init__.py").write_text(""),
        (folder / "linked/up").symlink_to(".."),
        (folder / "linked/tax.txt").symlink_to("../tax.txt"),
    ),
}
"""What came with the file, from the same stranger."""


@pytest.mark.short("strict")
@pytest.mark.parametrize("planted", PLANTED)
def test_a_named_file_reads_nothing_beside_it(arena: Arena, home: Path, planted: str) -> None:
    folder = home / "downloads"
    names = (".ssh/id_rsa", ".env", "tax.txt", "taxes/return.txt", "private.py", token())
    secrets = [secret_file(folder / name) for name in names[:-2]]
    secrets += [name_of_module := f"t{token()}", names[-1]]
    (folder / "private.py").write_text(f"secret = {name_of_module!r}\n")
    (folder / names[-1]).touch()
    (folder / "env.py").write_text(LOOKS)
    PLANTED[planted](folder)
    look = "import env, json; print(json.dumps(repr(env.Looks().look())))"
    command = [sys.executable, "-c", look]
    said = json.loads(subprocess.check_output(command, cwd=folder, text=True))
    assert all(secret in said for secret in secrets)
    options = {"policy": {"profile": arena.profile}, "timeouts": TIMEOUTS}
    with make_env(str(folder / "env.py"), **options) as suites:
        [found] = suites.env.call("look")
        assert "env.py" in repr(found)
    stolen = [secret for secret in secrets if secret in repr(found)]
    arena.judge(f"read what lies beside a file{planted}", "succeeds", bool(stolen), repr(found))
