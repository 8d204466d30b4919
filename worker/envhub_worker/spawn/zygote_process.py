"""The process of a zygote, from its start until it reads its configuration.

A server needs a zygote first, and its start takes longest. So ``serve --ahead`` starts one before
the server imports anything else. In the server's own interpreter the zygote imports all modules
that runners need; in another interpreter, or if jails bring their own packages, it imports no
package. Then it waits.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from envhub_worker import bootstrap
from envhub_worker.lockdown.mechanisms.environment import zygote_environment
from envhub_worker.protocol.runtime import OWN, Runtime, site_options
from envhub_worker.protocol.start_variables import at_start
from envhub_worker.spawn.channel import Channel

_END_S = 8.0


def ends_within(pidfd: int, seconds: float) -> bool:
    """Wait for the end of a process. ``Popen.wait`` with a timeout sleeps between looks, ever
    longer.
    """
    poller = select.poll()  # of descriptors beyond 1023, too
    poller.register(pidfd, select.POLLIN)
    return bool(poller.poll(seconds * 1000))


def resolved(runtime: Runtime) -> Runtime:
    """Returns the runtime with the path of its interpreter filled in."""
    return Runtime(runtime.python or sys.executable, runtime.packages)


class ZygoteProcess:
    """Owns the process, its channel, and a private folder.

    Args:
        runtime: The zygote's interpreter and the packages of its jails. With such packages the
            zygote starts without ``site`` and sees no packages, not even the interpreter's own.
        ahead: Whether to import before the configuration comes, so before any confinement. Only
            done in the server's own interpreter, whose packages the server itself has imported.
        granted: The environment variables of its jails.

    Attributes:
        environment: The environment that it was executed with.
        channel: The control channel; its first message is the configuration.
        folder: A private folder, removed by ``Spawner.close``.
        pid: The started process; with namespaces it only waits for the zygote.
    """

    def __init__(
        self,
        runtime: Runtime,
        runtime_dir: Path,
        granted: Mapping[str, str],
        *,
        ahead: bool = False,
    ) -> None:
        self.runtime = resolved(runtime)
        python, site = self.runtime.python, not runtime.packages
        self.environment = zygote_environment(os.environ, python, at_start(granted))
        self.folder = runtime_dir / f"zygote-{os.urandom(4).hex()}"
        self.folder.mkdir(mode=0o700)
        self.log = self.folder / "log"
        self.channel, theirs = Channel.pair()
        at_once = "ahead" if ahead and self.runtime == resolved(OWN) else ""
        at_once = "standard" if runtime.packages else at_once
        arguments = [str(theirs.fileno()), *([at_once] if at_once else [])]
        options = site_options() if self.runtime == resolved(OWN) else []
        with theirs, open(self.log, "ab") as log:
            self._process = subprocess.Popen(
                bootstrap.command(python, "zygote", *arguments, site=site, options=options),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd="/",
                env=self.environment,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        self.pid = self._process.pid
        self._pidfd = -1
        try:  # now: when the process ends, there may be no descriptor left
            self._pidfd = os.pidfd_open(self.pid)
        except OSError:
            self.discard()
            raise

    def serves(self, runtime: Runtime, granted: Mapping[str, str]) -> bool:
        """Whether the process was started with the arguments that these jails need."""
        runtime = resolved(runtime)
        environment = zygote_environment(os.environ, runtime.python, at_start(granted))
        return (self.runtime, self.environment) == (runtime, environment)

    def wait(self) -> int:
        """Returns the exit code; kills the process if it does not end soon."""
        if self._process.poll() is None and not ends_within(self._pidfd, _END_S):
            self._process.kill()
        return self._reaped()

    def _reaped(self) -> int:
        code = self._process.wait()
        if self._pidfd >= 0:
            os.close(self._pidfd)
            self._pidfd = -1
        return code

    def discard(self) -> None:
        """End the process unused."""
        self.channel.close()
        self._process.kill()
        self._reaped()
        self.log.unlink(missing_ok=True)
        self.folder.rmdir()
