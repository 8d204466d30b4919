"""``envhub-worker serve``: a worker server for the one client that started it.

The docstring of ``__main__.py`` has its contract. Heavy modules are imported after the zygote has
been started, so that both processes import at the same time.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import select
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from envhub_worker.find_extra import find_extra

if TYPE_CHECKING:
    from envhub_worker.spawn.zygote_process import ZygoteProcess


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``serve``."""
    parser.add_argument("--endpoint", required=True)
    parser.add_argument("--runtime-dir", type=Path, required=True)
    parser.add_argument("--readable-root", action="append", default=[])
    parser.add_argument("--ready-fd", type=int)
    parser.add_argument("--client-pidfd", type=int)
    parser.add_argument("--fd-path", type=Path)
    parser.add_argument("--until-eof", action="store_true")
    parser.add_argument("--announce", action="store_true")
    parser.add_argument("--ahead", action="store_true")
    parser.add_argument("--python", default="")
    parser.add_argument("--packages", default="")


def run(arguments: argparse.Namespace) -> int:
    """Run a worker server until a signal ends it or its client ends."""
    arguments.runtime_dir.mkdir(mode=0o700, exist_ok=True)
    try:
        return _serve_in(arguments)
    except BaseException as error:
        # A client that runs reads our log, then removes the folder; one that has gone does neither.
        client = 0 if arguments.until_eof else arguments.client_pidfd
        if client is not None and select.select([client], [], [], 0)[0]:
            from envhub_worker.lockdown.mechanisms.scratch import remove_tree

            remove_tree(str(arguments.runtime_dir))
        from envhub_worker.protocol.text import shortage

        if short := shortage(error, "here"):
            sys.exit(short)
        raise


def _serve_in(arguments: argparse.Namespace) -> int:
    ahead = _ahead(arguments)  # before the heavy imports, which both processes do at the same time
    gc.disable()  # as in the zygote: imports leave no garbage
    from envhub_worker.lockdown.mechanisms.process import raise_file_limit
    from envhub_worker.server.server import Server

    raise_file_limit()
    gc.freeze()
    gc.enable()
    announced = None
    if arguments.announce:
        surroundings = find_extra("surroundings")
        if surroundings is None:
            sys.exit("--announce needs envhub_worker.extras.surroundings, which is not installed")
        announced = surroundings.announcement(surroundings.measure())
    server = Server(
        arguments.endpoint,
        arguments.runtime_dir,
        arguments.readable_root,
        0 if arguments.until_eof else arguments.client_pidfd,  # stdin is readable at its end
        fd_path=arguments.fd_path,
        ahead=ahead,
    )
    server.stop_on(signal.SIGTERM, signal.SIGINT)
    if arguments.ready_fd is not None:
        with contextlib.suppress(BrokenPipeError):  # the client has ended, which the loop notices
            os.write(arguments.ready_fd, b"ready\n")
        os.close(arguments.ready_fd)
    if announced is not None:
        print(announced, flush=True)
    server.run()
    return 0


def _ahead(arguments: argparse.Namespace) -> ZygoteProcess | None:
    from envhub_worker.protocol.runtime import Runtime
    from envhub_worker.protocol.start_variables import fixed_hash_seed
    from envhub_worker.spawn.zygote_process import ZygoteProcess

    if not arguments.ahead:
        return None
    runtime = Runtime(arguments.python, arguments.packages)
    try:
        granted = fixed_hash_seed(os.environ)
        return ZygoteProcess(runtime, arguments.runtime_dir, granted, ahead=True)
    except OSError:  # opening a jail in that interpreter fails likewise, and reports the reason
        return None
