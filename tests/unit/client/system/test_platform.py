"""What stands in on macOS and Windows for what Linux alone has, and which names are others there.
``tests/attacks/files/test_names.py`` has what the names are for."""

import configparser
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.system import platform
from envhub_sandbox.system.platform import ignores_case, taken_as_one, wrong_here, wrong_on_windows
from tests.support.elsewhere import interpreter
from tests.support.elsewhere.caseless import without_case

_SETTINGS = Path(__file__).parents[4] / ".ci" / "elsewhere.ini"


def test_type_checkers_know_the_same_modules() -> None:
    """What they pass over elsewhere is what no client there imports."""
    settings = configparser.ConfigParser()
    settings.read(_SETTINGS)
    named = {
        section.removeprefix("mypy-").removesuffix(".*")
        for section in settings.sections()
        if settings.getboolean(section, "ignore_errors", fallback=False)
    }
    assert named == set(interpreter.LINUX_ALONE)


def test_this_platform_is_linux() -> None:
    assert (platform.IS_LINUX, platform.IS_WINDOWS, platform.NAME) == (True, False, "linux")
    assert platform.user_id() == os.geteuid()
    assert platform.own_cpus() == sorted(os.sched_getaffinity(0))
    assert platform.open_flags("O_NOFOLLOW", "O_NONSENSE") == os.O_NOFOLLOW
    assert platform.own_variables() == {}
    assert platform.boot_id() == Path("/proc/sys/kernel/random/boot_id").read_text().strip()


@pytest.mark.parametrize("name", ["a:b", "C:/x", "con", "CON.py", "x/nul", "lpt\u00b3", "a.", "a "])
def test_windows_reads_it_as_another(name: str) -> None:
    """Here it is a name as any other; what only begins like a device is one there, too."""
    assert wrong_on_windows(name)
    assert wrong_here(name) is None
    for same in ("env.py", "a b/c.d", "\u0436.txt", ".hidden", "icon", "com"):
        assert wrong_on_windows(same) is None


@given(st.lists(st.text("aAbB/\u00e9", min_size=1, max_size=6), max_size=6, unique=True))
def test_what_is_one_without_case_is_found(paths: list[str]) -> None:
    """Whichever names there are: those that fold to the same are found, and no others."""
    paths = [path for path in paths if "" not in path.split("/")]
    prefixes = {
        "/".join(path.split("/")[:end]) for path in paths for end in range(1, path.count("/") + 2)
    }
    clash = len({prefix.casefold() for prefix in prefixes}) < len(prefixes)
    assert (taken_as_one(paths) is not None) is clash


def test_a_file_system_is_tried(tmp_path: Path) -> None:
    assert not ignores_case(tmp_path)
    with without_case(tmp_path):
        assert ignores_case(tmp_path)
    assert not list(tmp_path.iterdir())
