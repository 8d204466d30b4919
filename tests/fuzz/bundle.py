"""Crash bundles that a stranger has made: read, asked what they want, and repeated on a dummy."""

import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

from envhub_sandbox.errors import BundleError, EnvHubError
from envhub_sandbox.extras.crash.bundle_reader import load_bundle, replayed_arguments, wishes
from envhub_sandbox.extras.crash.replay import replay
from tests.fuzz.oracle import demand
from tests.fuzz.targets import Dice
from tests.unit.client.session.test_bundle_reader import bundle as written

_MADE: list[Path] = []


class _Dummy:
    """An environment that does whatever it is asked."""

    def __init__(self) -> None:
        self.action_space = None
        self.num_envs = 2
        self._requests = Mock()

    def reset(self, **options: Any) -> None:
        """Done."""

    def step(self, actions: Any) -> None:
        """Done."""

    def call(self, name: str, *args: Any, **kwargs: Any) -> None:
        """Done."""

    def set_attr(self, name: str, values: Any) -> None:
        """Done."""

    def render(self) -> None:
        """Done."""


def bundles(dice: Dice) -> None:
    """It is read or refused, asks in print, and repeats nothing but requests."""
    if not _MADE:
        _MADE.append(written(Path(tempfile.mkdtemp(prefix="envhub-fuzz-"))))
    with tempfile.TemporaryDirectory(prefix="envhub-fuzz-") as folder:
        target = Path(folder) / "bundle"
        shutil.copytree(_MADE[0], target)
        for _ in range(dice.rng.choice((1, 1, 2, 4))):
            _spoil(dice, target)
        try:
            found = load_bundle(target)
        except EnvHubError as error:
            demand(isinstance(error, BundleError), f"{error!r} of a bundle")
            raise
        demand(wishes(found).isprintable(), "a wish that a terminal obeys")
        replayed_arguments(found)
        try:
            replay(_Dummy, found)
        except (AttributeError, TypeError, ValueError) as error:
            raise AssertionError(f"a replay broke off: {error!r}") from error


def tidy() -> None:
    while _MADE:
        shutil.rmtree(_MADE.pop().parent, ignore_errors=True)


def _spoil(dice: Dice, folder: Path) -> None:
    rng = dice.rng
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and not path.is_symlink()]
    if not files:
        return
    file, act = rng.choice(files), rng.random()
    data = file.read_bytes()
    if act > 0.95:
        rng.choice(_ACTS)(file)
        return
    document = _document(data) if file.suffix == ".json" and act < 0.85 else None
    if document is not None:
        data = json.dumps(_plain(dice.spoiler.value(document))).encode()
    elif file.suffix == ".bin" and act < 0.5:
        data = data[:24] + dice.spoiler.raw(data[24:])
    else:
        data = dice.spoiler.raw(data)
    _write(file, data)


def _write(file: Path, data: bytes) -> None:
    """A new file in the place of one: nothing is ever written to what a link may lead to."""
    file.unlink()
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
    with os.fdopen(os.open(file, flags, 0o600), "wb") as made:
        made.write(data)


def _document(data: bytes) -> Any:
    try:
        return json.loads(data)
    except (ValueError, RecursionError):  # spoiled before
        return None


def _folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def _link(file: Path) -> None:
    """To a file beside the bundle, which is as good as any that is nobody's business."""
    other = file.parent.parent / "other"
    file.rename(other)
    file.symlink_to(other)


def _fifo(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


_ACTS: tuple[Callable[[Path], object], ...] = (
    Path.unlink,
    _folder,
    _link,
    _fifo,
    lambda file: _write(file, b""),
)


def _plain(value: Any) -> Any:
    """What JSON can hold of it."""
    if type(value) is dict:
        return {str(key): _plain(item) for key, item in value.items()}
    if type(value) in (list, tuple):
        return [_plain(item) for item in value]
    return value if type(value) in (int, str, bool, float, type(None)) else repr(value)
