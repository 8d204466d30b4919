"""``envhub check --all``: each of a list is judged, and the worst of them is the verdict."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

from tests.corpus.entries import Entry
from tests.support.command_line import envhub

_QUICK = ("--steps", "4", "--resets", "0", "--n-envs", "1", "--memory", "1G")
_HONEST = Entry(group="honest")
_BROKEN = Entry(group="broken", env="def step(self, action):\n    raise RuntimeError('it broke')")


def test_each_of_a_list_is_judged(tmp_path: Path) -> None:
    """In its order, and told with what fails first; files beside it that say otherwise are none."""
    _HONEST.write(tmp_path / "honest")
    _BROKEN.write(tmp_path / "broken")
    (tmp_path / "empty").mkdir()
    forged = {"counts": {"passed": 3}, "results": []}
    (tmp_path / "index.json").write_text(json.dumps(forged))
    names = [str(tmp_path / name) for name in ("honest", "broken", "empty")]
    (tmp_path / "list").write_text("\n".join(["# ours", *names]))
    junit = tmp_path / "junit.xml"
    done = envhub("check", "--all", tmp_path / "list", "--json", "--junit", junit, *_QUICK, code=1)
    document = json.loads(done.stdout)
    assert document["counts"] == {"failed": 1, "not judged": 1, "passed": 1}
    failed, empty, honest = document["results"]
    assert [row["line"] for row in (failed, empty, honest)] == [3, 4, 2]
    [why] = failed["why"]
    assert re.fullmatch(r"runs: env\.py:\d+: RuntimeError: it broke", why)
    assert failed["report"]["passed"] is False
    assert honest["report"]["passed"] is True
    assert empty["report"] is None
    assert "no file 'env.py'" in empty["why"][0]
    said = [line.split("]")[1].split()[0] for line in done.stderr.splitlines() if "[" in line]
    assert said == ["passed", "failed", "not"]
    suites = ElementTree.parse(junit).getroot()
    assert [suite.attrib["failures"] for suite in suites] == ["1", "0", "0"]
    assert [suite.attrib["errors"] for suite in suites] == ["0", "1", "0"]
