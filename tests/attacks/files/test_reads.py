"""Reading files that a repository has no business with."""

import ctypes
import os
from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import SnapshotError
from tests.attacks.harness import HOSTILE, USER, Arena, OpenJail, token
from tests.attacks.repositories import write_environment

FAMILY = "Reading files"


def secret_file(path: Path) -> str:
    """Put a random token into a file that everybody may read and write; return it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    secret = token()
    path.write_text(secret)
    path.chmod(0o666)
    return secret


@pytest.mark.short("strict")
@pytest.mark.parametrize(
    ("what", "place"),
    [
        ("an ssh key", ".ssh/id_ed25519"),
        ("the Hub token file", ".cache/huggingface/token"),
        ("a file next to the snapshot", "projects/notes.txt"),
    ],
)
def test_private_files_cannot_be_read(jail: OpenJail, home: Path, what: str, place: str) -> None:
    secret = secret_file(home / place)
    jail.steal(f"read {what}", "read_file", secret, path=str(home / place))


@pytest.mark.parametrize("folder", ["/tmp", "/dev/shm"])
def test_shared_folders_of_the_host_cannot_be_read(jail: OpenJail, folder: str) -> None:
    path = Path(f"{folder}/envhub-attack-{token()}")
    try:
        jail.steal(f"read a file in {folder}", "read_file", secret_file(path), path=str(path))
    finally:
        path.unlink()


@pytest.mark.parametrize("way", ["symlink", "hard_link", "proc"])
def test_detours_lead_nowhere(jail: OpenJail, home: Path, way: str) -> None:
    secret = secret_file(home / "private")
    more = {"folders": [str(home)]} if way == "hard_link" else {}
    title = f"read a file through a {way.replace('_', ' ')}" + (" entry" if way == "proc" else "")
    jail.steal(title, f"read_through_{way}", secret, path=str(home / "private"), **more)


def test_links_in_the_repository_do_not_leave_it(arena: Arena, home: Path) -> None:
    secret = secret_file(home / "private")
    folder = home / "repository"
    folder.mkdir()
    (folder / "assets").symlink_to(home)
    (folder / "env.py").write_text("raise RuntimeError(open('assets/private').read())\n")
    assert (folder / "assets" / "private").read_text() == secret
    with pytest.raises(SnapshotError) as caught:
        make_env(str(folder), policy={"profile": arena.profile})
    text = str(caught.value)
    arena.judge("read through a link in the repository", "succeeds", secret in text, text)


def test_folders_cannot_be_listed(jail: OpenJail, home: Path) -> None:
    name = f"name-{token()}"
    (home / name).touch()
    jail.steal("list the home", "list_folder", name, path=str(home))


def test_files_cannot_be_probed_for(jail: OpenJail, home: Path) -> None:
    size = 100_000 + int(token()[:4], 16)
    (home / "model.bin").write_bytes(b"x" * size)
    (home / "latest").symlink_to(home / "model.bin")
    jail.attack(
        "learn that a file exists, its size, and where a link leads",
        "stat_link",
        lambda run: run.value == [size, str(home / "model.bin")],
        path=str(home / "latest"),
    )


def test_files_cannot_be_opened_by_handle(jail: OpenJail, home: Path) -> None:
    """A file handle goes around paths, mounts and chroots; only root's capability opens one."""
    secret = secret_file(home / "private")
    handle, kind = file_handle(home / "private")
    jail.steal(
        "open a file by its handle",
        "read_by_handle",
        secret,
        handle=handle,
        kind=kind,
        mounts=["/", "/usr", "/tmp", str(HOSTILE)],
        impossible="" if USER == "root" else "only root may open handles",
    )


def file_handle(path: Path) -> tuple[str, int]:
    buffer = ctypes.create_string_buffer(8 + 128)
    buffer[0:4] = (128).to_bytes(4, "little")
    mount = ctypes.c_int()
    libc = ctypes.CDLL(None, use_errno=True)
    done = libc.name_to_handle_at(-100, os.fsencode(path), buffer, ctypes.byref(mount), 0)
    assert done == 0, os.strerror(ctypes.get_errno())
    size = int.from_bytes(buffer.raw[:4], "little")
    kind = int.from_bytes(buffer.raw[4:8], "little", signed=True)
    return buffer.raw[8 : 8 + size].hex(), kind


def test_every_stage_is_confined(arena: Arena, home: Path) -> None:
    """Import, make_env, reset, step, render and close: no line of the repository runs outside."""
    secret = secret_file(home / "private")
    for stage in ("import", "make_env", "reset", "step", "render", "close"):
        text = loot_of(arena, stage, home, sandbox="process")
        control = loot_of(arena, stage, home, sandbox=None)
        assert secret in control, f"the control of stage {stage} failed: {control}"
        arena.judge(f"read a file during {stage}", "succeeds", secret in text, text)


def loot_of(arena: Arena, stage: str, home: Path, sandbox: str | None) -> str:
    """What an env of a repository brings out that reads a file in one of its stages."""
    source = STAGES.replace("STAGE", stage).replace("PRIVATE", str(home / "private"))
    repository = str(write_environment(home / f"at-{stage}", source))
    plain = {"trust_remote_code": True}
    options = {"policy": {"profile": arena.profile}} if sandbox else plain
    with make_env(repository, sandbox=sandbox, **options) as suites:
        suites.env.reset()
        suites.env.step([0])
        suites.env.render()
        found = str(suites.env.call("loot"))
    leaked = home / "leaked"
    if leaked.exists():
        found += leaked.read_text()
        leaked.unlink()
    return found


STAGES = """
LOOT = []

def at(stage):
    if stage == "STAGE":
        try:
            text = open("PRIVATE").read()
            LOOT.append(text)
            open("PRIVATE".replace("private", "leaked"), "w").write(text)
        except OSError as error:
            LOOT.append(str(error))

class Thief(Plain):
    render_mode = "rgb_array"
    metadata = {"render_modes": ["rgb_array"]}

    @property
    def loot(self):
        return list(LOOT)

    def reset(self, **given):
        at("reset")
        return super().reset(**given)

    def step(self, action):
        at("step")
        return super().step(action)

    def render(self):
        at("render")
        return np.zeros((2, 2, 3), np.uint8)

    def close(self):
        at("close")

def VECTOR(makers):
    at("make_env")
    return gym.vector.SyncVectorEnv(makers)

at("import")
"""


def test_granted_folder_can_be_read_and_nothing_beside_it(arena: Arena, home: Path) -> None:
    """The control of the sandbox itself: a granted path opens, so that denials mean something."""
    secret, other = secret_file(home / "granted" / "file"), secret_file(home / "beside")
    policy = {"readable": (str(home / "granted"),)}
    with arena.inside("read_file", {"path": str(home / "granted" / "file")}, policy) as run:
        assert secret in run.text
    with arena.inside("read_file", {"path": str(home / "beside")}, policy) as run:
        assert other not in run.text
