"""``envhub check``: an honest repository passes, and each fault is told by its check alone."""

import json
import re
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import SandboxUnavailableError, SnapshotError
from envhub_sandbox.extras.judge import judge as judging
from envhub_sandbox.extras.judge.checks import CHECKS, Severity
from envhub_sandbox.extras.judge.findings import Report
from envhub_sandbox.extras.judge.judge import judge
from envhub_sandbox.extras.judge.play import traces
from envhub_sandbox.extras.judge.play.probes import LEAK_CHECKS
from envhub_sandbox.extras.judge.settings import JudgeOptions
from envhub_sandbox.vector.pictures import png
from tests.corpus.entries import Entry
from tests.corpus.faults import FAULTS
from tests.corpus.honest import HONEST
from tests.support import inside
from tests.support.command_line import envhub, python
from tests.support.output.ci import obeyed
from tests.support.repositories import write_repository
from tests.support.samples import EXAMPLES

_BODY = """
length = _max_episode_steps = 10

def reward(self):
    return 1.0

def info(self):
    return {"is_success": self.is_late()}

def render(self):
    return np.zeros((4, 6, 3), np.uint8)
"""
_BOX = "gym.spaces.Box(-100, 100, (2,), np.float32)"
_PLACE = "np.array([self.at, self.count], np.float32)"
_PLAIN = Entry(group="honest", env=_BODY).source()
_HONEST = (
    _PLAIN.replace(_BOX, f"gym.spaces.Dict(agent_pos={_BOX})")
    .replace(_PLACE, f"{{'agent_pos': {_PLACE}}}")
    .replace("gym.spaces.Discrete(3)", "gym.spaces.Box(0.0, 2.5, (1,), np.float32)")
    .replace("int(action)", "int(action[0])")
)
"""What LeRobot's policies can play, too."""


def repository(folder: Path, text: str = _HONEST, **files: str) -> Path:
    papers = {"README__md": "# Walk", "LICENSE": "MIT", **files}
    return write_repository(folder, text, **papers)


def judged(folder: Path, steps: int = 25, **more: Any) -> Report:
    asked = JudgeOptions(reference=str(folder), arguments={"n_envs": 2}, steps=steps, **more)
    return judge(asked)


@pytest.mark.short
def test_an_honest_repository_passes(tmp_path: Path) -> None:
    """Every check that can be made of it holds, and the figures are of what was played."""
    report = judged(repository(tmp_path / "walk"), pictures=True)
    assert report.findings == []
    unasked = set(CHECKS) - {check for check, _ in report.passed}
    assert unasked == set(), "every check is made"
    assert (report.waiting, report.unmade) == ([], []), "of every task"
    assert report.figures["hub_env / 0"]["steps"] == 25
    assert report.figures["hub_env / 0"]["episodes"] == 4
    assert report.provenance["layers"], "it ran confined"
    play = report.plays["hub_env / 0"]
    assert [(one.returns, one.length) for one in play.episodes] == [((10.0,), 10)] * 4
    assert len(play.step_s) == 25
    assert 9 <= play.played <= 11, "memory, a few times while it was played"
    assert len(play.memory) == play.played + 4, "and after each round of resets"
    assert play.film.stills[0] == png(np.zeros((4, 6, 3), np.uint8))
    assert play.facts["observations"].startswith("Dict('agent_pos': Box(-100.0, 100.0, (2,)")
    assert report.asked["profile"] == "strict"


def test_for_whom_it_is_playable_is_noted(tmp_path: Path) -> None:
    text = _PLAIN.replace("length = _max_episode_steps = 10", "length = 10")
    report = judged(repository(tmp_path / "walk", text), 2, resets=0)
    [finding] = report.findings
    assert (finding.id, report.failures(Severity.WARNING)) == ("lerobot", [])
    for part in (
        "LeRobot cannot evaluate it",
        "agent_pos, env",
        "a vector (Box)",
        "_max_episode_steps",
    ):
        assert part in finding.message


@pytest.mark.parametrize(
    ("info", "end"),
    [('{"success": self.is_late()}', ", not 'success'"), ('{"is_success": None}', " as a bool")],
)
def test_a_success_by_another_name_is_noted(info: str, end: str, tmp_path: Path) -> None:
    """LeRobot would count none; the honest one is the control."""
    text = _HONEST.replace('{"is_success": self.is_late()}', info)
    [finding] = judged(repository(tmp_path / "walk", text), resets=0).findings
    assert finding.id == "lerobot"
    assert finding.message.endswith(f"info['is_success'] at the end of an episode{end}")


def test_a_dtype_that_changes_late_in_an_episode_is_found(tmp_path: Path) -> None:
    """The honest one above is the control."""
    late = _PLACE.replace("np.float32", "np.float64 if self.count > 8 else np.float32")
    [finding] = judged(repository(tmp_path / "walk", _HONEST.replace(_PLACE, late))).findings
    assert finding.id == "observation-dtype"


@pytest.mark.parametrize(
    ("old", "new", "checks"),
    [
        ("", "", set()),
        (".astype(np.float32)", "", {"observation-dtype"}),
        ("self.seen(), rewards", "self.seen(), rewards[:, None]", {"step-types"}),
    ],
    ids=["control", "dtype", "column"],
)
def test_batches_of_a_vector_class_are_looked_at(
    old: str, new: str, checks: set[str], tmp_path: Path
) -> None:
    text = HONEST["a batch in NumPy"].source()
    assert old in text
    report = judged(repository(tmp_path / "walk", text.replace(old, new)), resets=0)
    assert {one.id for one in report.failures(Severity.ERROR)} == checks


def test_each_mode_that_is_declared_is_rendered(tmp_path: Path) -> None:
    """Where make_env takes one; the control is the honest one of the corpus."""
    text = HONEST["several modes of rendering"].source()
    text = text.replace('"ansi": "o"', '"ansi": None').replace("[frame]}", "frame}")
    report = judged(repository(tmp_path / "wrong", text), 2, resets=0)
    [ansi, rgb] = report.failures(Severity.ERROR)
    assert (ansi.id, rgb.id) == ("render", "render")
    assert {ansi.message.split(":")[0], rgb.message.split(":")[0]} == {"ansi", "rgb_array_list"}
    text = HONEST["several modes of rendering"].source().replace("Env(render_mode)", "Env('ansi')")
    folder = repository(
        tmp_path / "deaf", text.replace('render_mode="rgb_array")', "render_mode='')")
    )
    [one, other] = judged(folder, 2, resets=0).failures(Severity.ERROR)
    for finding in (one, other):
        assert finding.message.endswith("it is declared and asked for, and is 'ansi'")


def test_what_was_not_asked_does_not_hold(tmp_path: Path) -> None:
    """Nor is it a finding; the honest one above is the control."""
    text = FAULTS["a mode that is not stated"].source()
    report = judged(repository(tmp_path / "walk", text), 2, resets=0)
    told = {check for check, _ in report.passed} | {one.id for one in report.findings}
    assert {"autoreset", *LEAK_CHECKS} & told == set()


@pytest.mark.parametrize(
    ("suite", "found"),
    [("'a'", set()), ("render_mode", {"loads"}), ("str(np.random.random())", {"loads"})],
)
def test_other_suites_each_time_are_told(suite: str, found: set[str], tmp_path: Path) -> None:
    """And end no judgement without a report; the first is the control."""
    text = HONEST["several modes of rendering"].source()
    made, _, vector = text.strip().rpartition("return ")
    folder = repository(tmp_path / "walk", f"{made}return {{{suite}: {{0: {vector}}}}}\n")
    failures = judged(folder, 2, resets=0).failures(Severity.ERROR)
    assert {one.id for one in failures} == found
    assert all("another result than the first time" in one.message for one in failures)


@pytest.mark.parametrize(
    ("is_slow_for_ever", "limit", "found"),
    [
        (False, "1e9", {"endless-unknown"}),
        (False, "40", set()),
        (False, "60", {"endless"}),
        (True, "40", {"slow-resets", "endless"}),
    ],
)
def test_a_machine_that_is_slow_for_a_while_fails_nobody(
    is_slow_for_ever: bool,
    limit: str,
    found: set[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where there is no time to look for an end, its limit says when it is; without one that is a
    note, and no check that holds. The control: each reset is slow, and there is time to look."""
    play, plays = traces.play, list[str]()

    def slow(*given: Any, **more: Any) -> traces.Trace:
        trace = play(*given, **more)
        plays.append("played")
        if is_slow_for_ever or len(plays) != 4:
            trace.times["reset_s"] = 100.0
        return trace

    monkeypatch.setattr(traces, "play", slow)
    monkeypatch.setattr(*inside.PATIENCE_FOR_AN_END, 1e9 if is_slow_for_ever else -1.0)
    endless = f"_max_episode_steps = {limit}; length = 1e9"
    text = _HONEST.replace("length = _max_episode_steps = 10", endless)
    report = judged(repository(tmp_path / "walk", text), 5, resets=0, episode_steps=50)
    assert len(plays) == 6
    assert {one.id for one in report.findings} == found
    assert ("endless" in {check for check, _ in report.passed}) is (found == set())


def test_a_task_is_closed_before_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else each would keep its jail, and there is room for two."""
    made, seen = list[Any](), list[str]()

    def making(**given: Any) -> Any:
        made.append(make_env(**given))
        return made[-1]

    def tell(what: str) -> None:
        if what == "a / 1":
            seen.append(f"{made[0]['a'][0].closed}")

    monkeypatch.setattr(judging, "make_env", making)
    text, _, vector = _HONEST.strip().rpartition("return ")
    both = f"{text}return {{'a': {{0: {vector}, 1: {vector}}}}}\n"
    judged(repository(tmp_path / "walk", both), 2, resets=0, tell=tell)
    assert seen == ["True"]


def test_actions_that_nobody_here_can_make_are_told(tmp_path: Path) -> None:
    """Of a space whose code stays in the jail; no bug of ours ends the judgement."""
    own = "class Own(gym.Space):\n    def sample(self, *_, **__):\n        return 1.0\n\nclass Walk"
    text = _HONEST.replace("class Walk", own, 1)
    text = text.replace("gym.spaces.Box(0.0, 2.5, (1,), np.float32)", "Own()")
    [finding] = judged(repository(tmp_path / "walk", text), 2).failures(Severity.ERROR)
    assert finding.id == "runs"


_TRYING = """
os = gym.vector.async_vector_env.sys.modules["os"]
libc = gym.vector.async_vector_env.sys.modules["ctypes"].CDLL(None)
libc.socket(2, 1, 0)
if not os.access(os.path.join(os.sep, "srv", "walk"), 0):
    libc.unlink(os.path.join(os.sep, "srv", "walk").encode())
"""
_ENDS = {"imports": "import nothing_of_this_name", "survives": "os.kill(os.getpid(), 9)"}


@pytest.mark.parametrize("check", _ENDS)
def test_what_was_tried_is_told_of_what_does_not_load(check: str, tmp_path: Path) -> None:
    """The control is a policy that permits the one, and a file of its own for the other."""
    text = _HONEST.replace("class Walk", f"{_TRYING}\n{_ENDS[check]}\n\nclass Walk", 1)
    report = judged(repository(tmp_path / "walk", text))
    assert {one.id for one in report.findings} == {check, "denied-network", "denied-files"}
    own = text.replace('os.sep, "srv"', '"."')
    policy = {"policy": {"network": "loopback"}}
    asked = JudgeOptions(reference=str(repository(tmp_path / "own", own)), arguments=policy)
    assert {one.id for one in judge(asked).findings} == {check}


def test_what_was_tried_is_told_of_what_dies(tmp_path: Path) -> None:
    """Whatever the policy says of restarts: no death is hidden from who judges."""
    text = _HONEST.replace("self.count += 1", "libc.socket(2, 1, 0); os.kill(os.getpid(), 9)")
    text = text.replace("class Walk", f"{_TRYING.partition('libc.socket')[0]}\nclass Walk", 1)
    folder = repository(tmp_path / "walk", text)
    policy = {"policy": {"restart": "transparent"}}
    report = judge(JudgeOptions(reference=str(folder), arguments=policy, steps=5, resets=0))
    assert {one.id for one in report.findings} == {"survives", "denied-network"}


def test_an_author_does_not_set_his_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What he would allow himself fails, wherever one stands; the caller's own file allows it."""
    text = _HONEST.replace("self.count += 1", "raise RuntimeError('it broke')")
    says = "[check]\nsteps = 5\nallow = ['runs']\n"
    folder = repository(tmp_path / "walk", text, envhub__toml=says)
    monkeypatch.chdir(folder)
    assert envhub("check", "env.py", "--steps", "5").returncode == 1
    refused = envhub("check", "env.py", "--settings", "envhub.toml")
    assert (refused.returncode, "is inside the repository" in refused.stderr) == (2, True)
    (tmp_path / "envhub.toml").write_text(says)
    envhub("check", ".", "--settings", "../envhub.toml", code=0)


def test_what_changes_meanwhile_is_not_judged(tmp_path: Path) -> None:
    """What was read is what is played, from the first play to the last, or there is no verdict."""
    folder = repository(tmp_path / "walk")
    plays = []

    def change(what: str) -> None:
        plays.append(what)
        if what == "hub_env / 0":
            (folder / "LICENSE").write_text("another")

    with pytest.raises(SnapshotError, match="changed during the check"):
        judge(JudgeOptions(reference=str(folder), arguments={"n_envs": 2}, steps=5, tell=change))
    assert "hub_env / 0" in plays


def test_missing_papers_are_told(tmp_path: Path) -> None:
    """Notes, which fail nothing unless one asks for it; the head of a card may name a licence."""
    report = judged(write_repository(tmp_path / "bare", _HONEST))
    assert {one.id for one in report.findings} == {"licence", "card"}
    assert (report.failures(Severity.ERROR), len(report.failures(Severity.NOTE))) == ([], 2)
    assert [one.id for one in report.failures(Severity.NOTE, ["card"])] == ["licence"]
    card = "---\nlicense: mit\n---\n# Walk"
    report = judged(write_repository(tmp_path / "card", _HONEST, README__md=card))
    assert report.findings == []


def test_the_command_line_judges(tmp_path: Path) -> None:
    """Exit codes, and the reports that were asked for; a name that a terminal would obey is a
    finding, and no reason not to judge."""
    good = envhub("check", EXAMPLES / "cartpole", "--steps", "20", "--json", code=0)
    assert json.loads(good.stdout)["passed"] is True
    folder = repository(tmp_path / "walk", _HONEST.replace("self.reward()", "1 / 0"))
    files = [f"--{kind}={tmp_path / kind}" for kind in ("junit", "sarif", "html")]
    bad = envhub("check", folder, "--steps", "5", *files, code=1)
    assert "ZeroDivisionError" in bad.stdout
    told = (tmp_path / "html").read_text()
    assert "ZeroDivisionError" in told
    assert "data:image/png" in told, "what fails is shown, too"
    assert 'failures="1"' in (tmp_path / "junit").read_text()
    [result] = json.loads((tmp_path / "sarif").read_text())["runs"][0]["results"]
    assert result["ruleId"] == "runs"
    assert result["locations"][0]["physicalLocation"]["region"]["startLine"] > 1
    policy = tmp_path / "policy.toml"
    policy.write_text('profile = "nothing"')
    refused = envhub("check", folder, "--policy", policy, "--json")
    assert (refused.returncode, "'nothing'" in refused.stderr) == (2, True), refused.stderr
    error = json.loads(refused.stdout)["error"]
    assert (error["type"], error["exit_code"]) == ("PolicyError", 2)
    assert f"{policy}: " in error["message"]
    allowed = envhub("check", folder, "--steps", "5", "--allow", "runs", "--github", code=0)
    assert allowed.stderr.endswith(": passed.\n")
    [command] = obeyed(allowed.stdout)
    line = _HONEST.partition("self.reward()")[0].count("\n") + 1
    assert command.startswith(f"::error file=env.py,line={line},title=envhub check%3A runs")
    nowhere = envhub("check", tmp_path / "nowhere")
    assert nowhere.returncode == 3, "it could not be judged"
    text = _HONEST.replace(
        "return gym.vector.SyncVectorEnv([Env] * n_envs)",
        "return {'a\\x9b': {0: gym.vector.SyncVectorEnv([Env] * n_envs)}}",
    )
    found = judged(repository(tmp_path / "named", text)).findings
    assert {one.id for one in found} == {"loads"}


_WITHOUT_NAMESPACES = """
import json, os, sys
from pathlib import Path
from typer.testing import CliRunner
from envhub_sandbox.cli.app import app
from envhub_worker.lockdown.mechanisms import namespaces

namespaces.enter_user_namespace(os.getuid(), os.getgid())
namespaces.forbid_what_is_counted()
folder = Path(sys.argv[1])
os.environ["GITHUB_STEP_SUMMARY"] = str(folder / "summary")
check = ["check", str(folder / "walk"), "--steps=2", "--resets=0", "--n-envs=1"]
chosen = [*check, "--profile=no-userns"]
told = []
for words in (check, [*chosen, f"--html={folder / 'html'}"], [*chosen, "--github", "--json"]):
    done = CliRunner().invoke(app, words)
    told.append((done.exit_code, done.stdout, done.stderr))
(folder / "told").write_text(json.dumps(told))
"""


def test_a_host_without_user_namespaces_is_told_of(tmp_path: Path) -> None:
    """Nothing weaker is taken by itself; where one names it, each form says what is not there."""
    text = _HONEST.replace('["rgb_array"]', "[]").replace('= "rgb_array"', "= None")
    repository(tmp_path / "walk", text)
    python("-c", _WITHOUT_NAMESPACES, tmp_path)
    refused, shown, github = json.loads((tmp_path / "told").read_text())
    assert refused[:2] == [6, ""], refused
    for words in ("user.max_user_namespaces is 0", "sudo sysctl", "--profile no-userns"):
        assert words in refused[2]
    assert (shown[0], github[0]) == (0, 0), (shown, github)
    told, _, rest = github[1].partition("\n{")
    found = json.loads("{" + rest.rpartition("\n}")[0] + "}")["confinement"]
    assert (found["asked"], found["profile"], found["recorded"]) == ("no-userns", "no-userns", True)
    missing = {one["layer"]: one["why"] for one in found["missing"]}
    assert {"pid-namespace", "mount-namespace"} <= set(missing)
    without = f"pid-namespace: {missing['pid-namespace']}"
    page, summary = (tmp_path / "html").read_text(), (tmp_path / "summary").read_text()
    [notice] = obeyed(github[1])
    for text in (shown[1], page, summary, notice, told.replace(notice, "")):
        said = unescape(text)
        assert re.search(r"confined by:? +no-userns, 1\d layers", said)
        assert re.search(rf"not enforced:? +{re.escape(without)}", said)


def test_where_recording_is_refused_it_is_judged_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what was tried is no finding then, as nobody has seen it."""

    def refusing(**given: Any) -> Any:
        if given["policy"].record_denials:
            raise SandboxUnavailableError("this host cannot enforce seccomp: no\nlistener")
        return make_env(**given)

    monkeypatch.setattr(judging, "make_env", refusing)
    text = _HONEST.replace("class Walk", f"{_TRYING}\n\nclass Walk", 1)
    report = judged(repository(tmp_path / "walk", text), 2, resets=0)
    assert report.findings == []
    assert not [check for check, _ in report.passed if check.startswith("denied-")]
    last = [*report.confinement.lines()][-1]
    why = "this host cannot enforce seccomp: no listener"
    assert last == f"not recorded: denied attempts: {why}"
