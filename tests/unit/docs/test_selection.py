"""What a run takes of the tests: ``--one-case`` loses no test function, and a full run no case."""

import os
from pathlib import Path

import pytest

from tests.support.plugins import selection

_TESTS = """
import pytest

def test_alone(): ...

@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_both_lanes(lane, number): ...

@pytest.mark.parametrize("text", ["a[b]", "c"])
class TestTexts:
    def test_first(self, text): ...
    def test_second(self, text): ...
"""


class _Chosen:
    """A plugin of the inner run, which keeps what that run would do."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        self.names = [item.name for item in session.items]


def _chosen(folder: Path, *options: str) -> set[str]:
    chosen = _Chosen()
    # confcutdir: without it, each entry of the folders above is looked at
    apart = ["-c", os.devnull, f"--rootdir={folder}", f"--confcutdir={folder}"]
    apart += ["--import-mode=importlib", "-p", "no:cacheprovider", "-p", "no:faulthandler"]
    apart += ["-p", selection.__name__]
    code = pytest.main([*apart, "--collect-only", "-q", *options, str(folder)], plugins=[chosen])
    assert code == pytest.ExitCode.OK
    return set(chosen.names)


def test_one_case_keeps_each_test_and_lane(tmp_path: Path) -> None:
    (tmp_path / "test_inner.py").write_text(_TESTS)
    numbered = {f"test_both_lanes[{lane}-{n}]" for lane in ("auto", "frames") for n in (1, 2, 3)}
    first = {"test_alone", "test_first[a[b]]", "test_second[a[b]]"}
    assert _chosen(tmp_path) == first | numbered | {"test_first[c]", "test_second[c]"}
    kept = _chosen(tmp_path, "--one-case")
    assert kept == first | {"test_both_lanes[auto-1]", "test_both_lanes[frames-1]"}
