"""Files with settings of a judgement: a caller's policy, and his options."""

from pathlib import Path

import pytest

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.extras.judge import settings
from envhub_sandbox.settings.policy import policy_from


def test_a_policy_is_a_file(tmp_path: Path) -> None:
    """Options change what it says, limit by limit, and nothing else of it."""
    file = tmp_path / "policy.toml"
    file.write_text('network = "loopback"\n[limits]\nprocesses = 9\nopen_files = 64\n')
    options = {"limits": {"processes": 12}}
    made = policy_from(settings.merged_settings(settings.read_file(file), options), None)
    assert (made.network, made.limits.processes, made.limits.open_files) == ("loopback", 12, 64)
    limits = {"processes": 12, "open_files": 64}
    assert made == policy_from({"network": "loopback", "limits": limits}, None)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("network =", "not valid TOML"),
        ("#" * 20_000, "larger than"),
        ("x = " + "[" * 5_000, "not valid TOML"),
        ("limits = 3", r"\[limits\]"),
        ('netwrok = "none"', "has no field netwrok"),
        (None, "cannot be read"),
    ],
    ids=range(6),
)
def test_what_is_no_policy_is_refused(text: str | None, says: str, tmp_path: Path) -> None:
    """With the reason; a misspelt field that did nothing would be a hole."""
    file = tmp_path / "policy.toml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(PolicyError, match=says):
        policy_from(settings.merged_settings(settings.read_file(file), {}), None)


def options(folder: Path, text: str) -> dict[str, object]:
    file = folder / "envhub.toml"
    file.write_text(text)
    return settings.read_settings(file, ["steps", "fail_on"])


def test_options_stand_in_a_file(tmp_path: Path) -> None:
    found = options(tmp_path, '[check]\nsteps = 9\nfail-on = "note"')
    assert found == {"steps": 9, "fail_on": "note"}
    assert options(tmp_path, "") == {}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[check]\ntrust = "me"', "has no option trust; there are fail-on, steps"),
        ("[check]\nstep = 9", r"no option step \(did you mean 'steps'\?\); there are"),
        ("[checks]\nsteps = 9", r"has checks \(did you mean 'check'\?\)"),
        ("check = 3", "a table"),
    ],
)
def test_a_file_that_says_nothing_is_refused(text: str, says: str, tmp_path: Path) -> None:
    """A misspelt option that did nothing would let something pass."""
    with pytest.raises(PolicyError, match=says):
        options(tmp_path, text)


def test_what_is_judged_has_no_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    judged, link = tmp_path / "judged", tmp_path / "link"
    (judged / "sub").mkdir(parents=True)
    (judged / "env.py").touch()
    link.symlink_to(judged)
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "mine.toml").symlink_to(judged / "envhub.toml")
    for file in (judged / "envhub.toml", judged / "sub/envhub.toml", tmp_path / "mine.toml"):
        for reference in (judged, link, judged / "env.py", f"{link}:env.py", "~/link"):
            assert settings.is_judged(file, str(reference)), (file, reference)
    (tmp_path / "with:colon").mkdir()
    for reference in (str(tmp_path / "with:colon"), f"{tmp_path / 'with:colon'}:env.py"):
        assert settings.is_judged(tmp_path / "with:colon" / "envhub.toml", reference)
    (judged / "out.toml").symlink_to(tmp_path / "envhub.toml")
    (judged / "up").symlink_to(tmp_path)
    assert settings.is_judged(judged / "out.toml", str(judged)), "it chooses a file elsewhere"
    assert settings.is_judged(link / "up" / "envhub.toml", str(judged))
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert not settings.is_judged(tmp_path / "loop", str(judged))
    assert not settings.is_judged(judged / "envhub.toml", str(tmp_path / "nowhere"))
    assert not settings.is_judged(tmp_path / "envhub.toml", str(judged))
    assert not settings.is_judged(judged / "envhub.toml", "org/repo@0123")


def test_no_report_goes_where_a_link_of_the_judged_leads(tmp_path: Path) -> None:
    """Links of the caller's own may lead into it; a file of it is written, as it always was."""
    judged, mine = tmp_path / "judged", tmp_path / "mine"
    judged.mkdir()
    mine.symlink_to(judged)
    (judged / "report").symlink_to(tmp_path / "victim")
    (judged / "up").symlink_to(tmp_path)
    for path in (judged / "report", mine / "report", judged / "up/victim", judged / "up/judged/x"):
        with pytest.raises(PolicyError, match="a link in the repository"):
            settings.refuse_link_of_the_judged(path, f"{mine}:env.py")
    for path, reference in (
        *((one, str(judged)) for one in (judged / "new", mine / "new", tmp_path / "victim")),
        *((judged / "report", one) for one in ("org/repo", str(tmp_path / "nowhere"))),
    ):
        settings.refuse_link_of_the_judged(path, reference)


def test_where_it_lies_below_this_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here/a/b").mkdir(parents=True)
    (tmp_path / "here/a/b/env.py").touch()
    (tmp_path / "link").symlink_to(tmp_path / "here/a")
    monkeypatch.chdir(tmp_path / "here")
    below = {"./a": "a/", "./a/b": "a/b/", "./a/b/env.py": "a/b/", "./a:b/env.py": "a/"}
    below |= {str(tmp_path / "here/a"): "a/", "../link/b": "a/b/", "a/b": "a/b/"}
    elsewhere = ("./", "../", "../here", "a/b@main", "org/repo@main", "./nowhere")
    for reference, folder in {**below, **dict.fromkeys(elsewhere, "")}.items():
        assert settings.folder_below_here(reference) == folder, reference
