"""A runner in this process, for a debugger: no server, no jail, no lane; the repository is trusted.

    python -m pdb -m tests.support.in_process.runner_here tests/samples/cartpole

loads the folder's ``env.py``, builds two sub-environments, resets and steps them. A breakpoint
anywhere in ``worker/envhub_worker/runner`` or in the repository is met.
"""

from __future__ import annotations

import sys
from pathlib import Path

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest.manifest import EnvManifest, decode_manifest
from envhub_worker.protocol.stream import Packet
from envhub_worker.runner.loader import PACKAGE
from envhub_worker.runner.runner import Runner


class RunnerHere:
    """A runner of one repository, whose modules can be imported until the end of a ``with``."""

    def __init__(self, folder: Path, n_envs: int = 2, entry: str = "env.py") -> None:
        self._before = set(sys.modules), list(sys.path), sys.dont_write_bytecode
        self._runner = Runner(str(folder.absolute()), entry)
        loaded = self.ask(m.Load(n_envs, False, None, {}))
        assert isinstance(loaded, m.LoadDone), loaded
        self.manifest: EnvManifest = decode_manifest(loaded.manifest, max_elements=1 << 24).envs[0]
        task = self.manifest
        self.ask(m.Build(1, task.suite, task.task, 0, task.num_envs))

    def __enter__(self) -> RunnerHere:
        return self

    def __exit__(self, *_: object) -> None:
        """Or the next one would be given this one's ``env.py``, which has the same name."""
        modules, sys.path[:], sys.dont_write_bytecode = self._before
        for name in sys.modules.keys() - modules:
            if name.partition(".")[0] == PACKAGE:
                del sys.modules[name]

    def ask(self, message: m.Message) -> m.Message:
        """What it answers; ``m.RaisedException`` has the traceback of the repository's error."""
        return m.unpack(self._runner.reply(Packet(1, m.pack(message))))


def main(folder: str) -> None:
    runner = RunnerHere(Path(folder))
    runner.manifest.action_space.seed(0)
    print(runner.ask(m.Reset(1, None, None, None)))
    for _ in range(10):
        print(runner.ask(m.Step(1, runner.manifest.action_space.sample())))


if __name__ == "__main__":
    main(sys.argv[1])
