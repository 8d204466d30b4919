"""What a stranger's files declare is data: what could build or run code does not get through."""

import re
from pathlib import Path

import pytest

from envhub_sandbox.extras.packages import declared as module
from envhub_sandbox.extras.packages.declared import DeclaredPackages, declared, read
from tests.support.packages.refusals import refused_dependency

HASH = "sha256:" + "0a" * 32


def repository(folder: Path, **files: str) -> DeclaredPackages | None:
    """What a repository of these files declares; ``__`` in a name is a dot."""
    (folder / "env.py").write_text("")
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)
    return declared(folder, "env.py")


def plain(found: DeclaredPackages | None) -> list[str]:
    return [str(one) for one in found.wanted]


def script(*lines: str) -> str:
    inside = "".join(f"# {line}\n" for line in lines)
    return f"# /// script\n{inside}# ///\nimport this_never_runs\n"


def test_plain_requirements_get_through(tmp_path: Path) -> None:
    text = "# wanted\nnumpy>=2\n\n  # more\nminigrid[wfc]==3.0 # pinned\nfoo; python_version<'3.12'"
    assert plain(repository(tmp_path, requirements__txt=text)) == [
        *("numpy>=2", "minigrid[wfc]==3.0", 'foo; python_version < "3.12"')
    ]


def test_hashes_stand_on_the_line_or_on_the_next(tmp_path: Path) -> None:
    text = f"numpy==2.0 --hash={HASH}\nfoo==1 \\\n    --hash={HASH} \\\n    --hash={HASH}\nbar\n"
    found = repository(tmp_path, requirements__txt=text)
    assert [(len(one.hashes), one.where) for one in found.wanted] == [
        (1, "line 1 of requirements.txt"),
        (2, "line 2 of requirements.txt"),
        (0, "line 5 of requirements.txt"),
    ]
    assert found.wanted[0].hashes == (HASH,)


@pytest.mark.parametrize(
    "line",
    [
        *("-e ./here", "--index-url https://index.example", "-r other.txt", "--no-binary :all:"),
        *("./here", "git+https://git.example/repo.git", "here @ file:///tmp/here", "/tmp/x.whl"),
        *("here @ https://files.example/here.tar.gz", "--find-links .", "a --config-settings=a"),
        *("numpy>=2 \\", "numpy \\\n  --no-binary \\\n  :all:", "${SECRET}"),
        *("-c constraints.txt", "numpy==1.0 --hash=sha256:00"),
        *(f"numpy --hash={HASH} -e .", f"numpy --hash={HASH}; --no-binary x", "a" * 3000),
        *(f"-e . --hash={HASH}", f"./here --hash={HASH}", f"a @ file:///a --hash={HASH}"),
        *("numpy; (" + "(" * 900, f"{'a' * 3000} --hash={HASH}"),
        # read with Python's escapes and printed without them, this is three lines to uv
        *(rf"a; os_name == 'x{one}-e .{one}y'" for one in (r"\n", r"\x0a", r"\r", r"\u000a")),
        r"a; os_name == 'x\" or os_name == \"x\"\n-i https://index.example\na; \"\" == \"'",
        *("""a; os_name == 'x" or "y'""", '''a; os_name == "x' or 'y"''', "numpy>=2\x00"),
    ],
)
def test_whatever_could_run_code_does_not(tmp_path: Path, line: str) -> None:
    with refused_dependency("requirement", match=r"line 2 of requirements\.txt"):
        repository(tmp_path, requirements__txt=f"numpy\n{line}\n")


@pytest.mark.parametrize("line", ["-e ./here", "here @ file:///tmp/here", "a" * 3000])
def test_nor_in_the_other_files(tmp_path: Path, line: str) -> None:
    """Where a list of TOML holds it; nor is a second block taken, which could be another's."""
    with refused_dependency("requirement", match=r"in the script metadata of env\.py"):
        repository(tmp_path, env__py=script(f"dependencies = ['{line}']"))
    project = f"[project]\nname = 'x'\ndependencies = ['{line}']\n"
    with refused_dependency("requirement", match=r"in \[project\] of pyproject\.toml"):
        repository(tmp_path, env__py="", pyproject__toml=project)
    for end in (r"\n", r"\r", r"\u2028"):  # which TOML reads before we do
        text = f"""[project]\ndependencies = ["a; os_name == 'x{end}-e .{end}y'"]\n"""
        with refused_dependency("requirement", match=r"in \[project\] of pyproject\.toml"):
            repository(tmp_path, env__py="", pyproject__toml=text)
    with refused_dependency("requirement", match="2 blocks"):
        repository(tmp_path, env__py=script("dependencies = []") + script("dependencies = []"))


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "requirements.txt"
    for data in (b"\xff\xfe\x00", b"\x80numpy"):
        path.write_bytes(data)
        with refused_dependency("requirement", match="cannot be read"):
            read(tmp_path, path.name)
    path.write_text("numpy\n" * module.MAX_BYTES)
    with refused_dependency("requirement", match="bytes"):
        read(tmp_path, path.name)
    path.write_text("numpy\n" * (module.MAX_REQUIREMENTS + 1))
    with refused_dependency("requirement", match="requirements"):
        read(tmp_path, path.name)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig"])
def test_what_windows_writes_is_read(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "requirements.txt").write_bytes("numpy>=2\r\nfoo\r\n".encode(encoding))
    assert [str(one) for one in read(tmp_path, "requirements.txt")[0]] == ["numpy>=2", "foo"]


def test_further_files_of_the_repository_are_read(tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    (tmp_path / "more/base.txt").write_text("numpy\n-r ../requirements.txt\n-c=held.txt\n")
    (tmp_path / "more/held.txt").write_text("foo<2\n-r deeper.txt\n")
    (tmp_path / "more/deeper.txt").write_text("bar<3\n")
    found = repository(tmp_path, requirements__txt="a\n-r more/base.txt\n")
    assert [str(one) for one in found.wanted] == ["a", "numpy"]
    assert [(str(one), one.where) for one in found.constraints] == [
        ("foo<2", "line 1 of more/held.txt"),
        ("bar<3", "line 1 of more/deeper.txt"),
    ]
    for number in range(module.MAX_FILES + 1):
        (tmp_path / f"{number}.txt").write_text(f"-r {number + 1}.txt\n")
    with refused_dependency("requirement", match="includes more than"):
        repository(tmp_path, requirements__txt="-r 0.txt\n")


@pytest.mark.parametrize(
    "named", ["../outside.txt", "/etc/hostname", "more", "https://a.example/r"]
)
def test_no_file_beyond_the_repository_is_read(tmp_path: Path, named: str) -> None:
    (tmp_path / "outside.txt").write_text("numpy\n")
    (tmp_path / "repo/more").mkdir(parents=True)
    with refused_dependency("requirement", match="not a file of the repository"):
        repository(tmp_path / "repo", requirements__txt=f"-r {named}\n")


def test_the_repository_itself_is_its_project(tmp_path: Path) -> None:
    """Its modules are there already: what its project needs counts, and extras that are named."""
    (tmp_path / "pyproject.toml").write_text(
        '[project]\ndependencies = ["a"]\n[project.optional-dependencies]\nx = ["b"]\ny = ["c"]\n'
    )
    for line, names in (("-e .", ["a"]), (".", ["a"]), ("--editable=./[x, y]", ["a", "b", "c"])):
        (tmp_path / "requirements.txt").write_text(f"{line}\nd\n")
        wanted, _ = read(tmp_path, "requirements.txt")
        assert [one.requirement.name for one in wanted] == [*names, "d"]
    (tmp_path / "pyproject.toml").unlink()
    with refused_dependency("requirement", match="installs the repository itself"):
        read(tmp_path, "requirements.txt")


def test_the_file_beside_the_entry_counts(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep/env.py").write_text("")
    (tmp_path / "requirements.txt").write_text("of-root\n")
    assert plain(declared(tmp_path, "deep/env.py")) == ["of-root"]
    (tmp_path / "deep/requirements.txt").write_text("of-entry\n")
    assert plain(declared(tmp_path, "deep/env.py")) == ["of-entry"]


def test_what_was_seen_and_not_read_is_said(tmp_path: Path) -> None:
    """Files of other programs, and what is known only once it is built."""
    for name in ("environment.yml", "setup.py"):
        (tmp_path / name).write_text("")
    text = "[project]\nname = 'x'\ndynamic = ['dependencies']\n[tool.poetry]\n"
    assert repository(tmp_path, pyproject__toml=text) is None
    assert module.not_read(tmp_path, "env.py") == [
        *("environment.yml", "setup.py", "[tool.poetry] of pyproject.toml"),
        "dynamic dependencies of pyproject.toml",
    ]


def test_the_most_particular_file_counts(tmp_path: Path) -> None:
    def found(**files: str) -> tuple[str, list[str], str]:
        made = repository(tmp_path, **files)
        return made.source, plain(made), made.python

    project = "[project]\nname = 'x'\nrequires-python = '>=3.11'\ndependencies = ['of-project']\n"
    assert repository(tmp_path) is None
    assert found(pyproject__toml=project) == ("pyproject.toml", ["of-project"], ">=3.11")
    assert found(requirements__txt="of-file\n") == ("requirements.txt", ["of-file"], ">=3.11")
    text = script("requires-python = '<3.13'", "dependencies = [", "  'of-script',", "]")
    assert found(env__py=text) == ("env.py", ["of-script"], "<3.13")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("env__py", "# /// script\n# dependencies = ['x']\n"),
        ("env__py", "# /// other\n# dependencies = ['x']\n# ///\n"),
        ("env__py", "# /// script\n# dependencies = ['x']\nx = 1\n# ///\n"),
        ("env__py", "'''\n  # /// script\n  # dependencies = ['x']\n  # ///\n'''\n"),
        ("pyproject__toml", "[tool.ruff]\nline-length = 100\n"),
        ("pyproject__toml", "[project]\nname = 'x'\ndynamic = ['dependencies']\n"),
    ],
)
def test_what_declares_nothing(tmp_path: Path, name: str, text: str) -> None:
    """As PEP 723 says: a block that is not closed, of another kind, interrupted or indented. Nor a
    project that only configures tools, or says what it needs once it is built."""
    assert repository(tmp_path, **{name: text}) is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[project]\ndependencies = 'numpy'\n", "not a list"),
        ("[project]\ndependencies = [1]\n", "not a list"),
        ("[project]\nrequires-python = 3\n", "requires-python"),
        ("[project]\nrequires-python = 'soon'\n", "requires-python"),
        ("[project\n", "not valid TOML"),
        ("x = " + "[" * 9000, "not valid TOML"),
        ("a." * 2000 + "a.a = 1", "too long"),
        ("#" * (module.MAX_BYTES + 1), "too long"),
        ("[project]\ndependencies = [" + "'a'," * (module.MAX_REQUIREMENTS + 1) + "]", "at most"),
    ],
)
def test_a_spoiled_project_is_refused(tmp_path: Path, text: str, said: str) -> None:
    with refused_dependency("requirement", match=re.escape(said)) as caught:
        repository(tmp_path, pyproject__toml=text)
    assert "pyproject.toml" in str(caught.value)
    assert "dependencies='host'" in str(caught.value)
