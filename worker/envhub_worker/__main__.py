"""The worker's program. Its contract:

``envhub-worker serve --endpoint E --runtime-dir D [--readable-root P ...] [--ready-fd N]
[--client-pidfd N] [--fd-path F] [--until-eof] [--announce] [--ahead [--python X] [--packages Y]]``

- argv: ``E`` is the ZeroMQ endpoint to bind, ``ipc://`` in a folder of mode 0700. ``D`` is an
  existing private folder for what lives as long as the server; it is removed at the end. ``P``
  are the folders that snapshots may lie in; nothing else of the machine's data is shown to a
  jail.
- file descriptors: ``--ready-fd`` gets one line (``ready``) once the endpoint is bound, and is
  closed. ``--client-pidfd`` is a pidfd of the client: when that process ends, so does all of this.
  ``--until-eof`` is the same for a client that can hand over nothing but a pipe: the server ends
  when stdin does. Else stdin is not read; stdout and stderr are for people.
- in a container: ``F`` is where the socket that takes descriptors shall lie, in a folder that is
  shared with the client; ``D`` need not be. ``D`` is made if it is missing. ``--announce`` prints
  one line of JSON once the endpoint is bound: what holds around this process
  (``lockdown/surroundings.py``).
- ``--ahead`` starts a zygote at once, in the interpreter ``X`` and for the packages ``Y``, by
  default this interpreter with its own, for whoever opens the first jail.
- environment: nothing is read from it but what Python itself needs.
- exit code: 0 after a stop, 2 for wrong arguments.

``envhub-worker listen [--bind tcp://127.0.0.1:5555] [--key FILE] [--authorized-clients FILE]
[--insecure-loopback] [--state-dir D] [quotas]`` serves clients on other hosts. It keeps keys and
snapshots in ``D``, by default below ``$XDG_STATE_HOME``. ``envhub-worker keygen [--out DIR]``
makes a key pair, ``envhub-worker status`` says who uses a listening server, ``envhub-worker drain``
ends it gently.

``envhub-worker health [--port 5555] [--state-dir D]`` exits with 0 if a server of this container
answers, else 1.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import select
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from envhub_worker.spawn.zygote_process import ZygoteProcess


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command: see the head of this file."""
    # jails of root are another user, who must get through to what we make; what is private says so
    os.umask(0o022)
    argv = sys.argv[1:] if argv is None else argv
    arguments = _parser(remote=argv[:1] != ["serve"]).parse_args(argv)
    run: Callable[[argparse.Namespace], int] = arguments.run
    return run(arguments)


def _serve(arguments: argparse.Namespace) -> int:
    """Run a worker server until it is told to stop or its client ends."""
    arguments.runtime_dir.mkdir(mode=0o700, exist_ok=True)
    try:
        return _serve_in(arguments)
    except BaseException:
        if _client_has_gone(arguments):  # one that is there reads our log, and then removes it
            from envhub_worker.lockdown.mechanisms.scratch import remove_tree

            remove_tree(str(arguments.runtime_dir))
        raise


def _client_has_gone(arguments: argparse.Namespace) -> bool:
    fd = 0 if arguments.until_eof else arguments.client_pidfd
    return fd is not None and bool(select.select([fd], [], [], 0)[0])


def _serve_in(arguments: argparse.Namespace) -> int:
    ahead = _ahead(arguments)  # before anything heavy is imported: both are at it at once
    gc.disable()  # as in the zygote: what is imported stays
    from envhub_worker.server import Server

    gc.freeze()
    gc.enable()
    announced = _announced() if arguments.announce else None
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
        with contextlib.suppress(BrokenPipeError):  # a client that has gone: the loop sees it
            os.write(arguments.ready_fd, b"ready\n")
        os.close(arguments.ready_fd)
    if announced is not None:
        print(announced, flush=True)
    server.run()
    return 0


def _ahead(arguments: argparse.Namespace) -> ZygoteProcess | None:
    from envhub_worker.protocol.runtime import Runtime
    from envhub_worker.spawn.zygote_process import ZygoteProcess

    if not arguments.ahead:
        return None
    runtime = Runtime(arguments.python, arguments.packages)
    try:
        return ZygoteProcess.ahead(arguments.runtime_dir, runtime)
    except OSError:  # whoever opens a jail in that interpreter is told
        return None


def _announced() -> str:
    from envhub_worker.lockdown import surroundings

    return surroundings.announcement()


def _health(arguments: argparse.Namespace) -> int:
    """Say whether a server answers: one that listens by its key, any other by its greeting."""
    from envhub_worker.cli.health import answers
    from envhub_worker.cli.status import is_healthy

    healthy = is_healthy(arguments.state_dir)
    return 0 if healthy or (healthy is None and answers("127.0.0.1", arguments.port)) else 1


def _listen(arguments: argparse.Namespace) -> int:
    """Serve clients on other hosts."""
    from envhub_worker.cli import listen

    return listen.run(arguments)


def _status(arguments: argparse.Namespace) -> int:
    """Say who uses a listening server."""
    from envhub_worker.cli import status

    return status.run(arguments)


def _drain(arguments: argparse.Namespace) -> int:
    """Tell the server that listens here to end, gently."""
    from envhub_worker.cli import drain

    return drain.run(arguments)


def _keygen(arguments: argparse.Namespace) -> int:
    """Make a key pair, and say its public key."""
    from envhub_worker.access import keys
    from envhub_worker.protocol.keys import key_text

    pair = keys.generate()
    try:
        secret, public = keys.save(pair, arguments.out, arguments.name)
    except FileExistsError as error:
        sys.stderr.write(
            f"envhub-worker keygen: {error.filename} is there already, and is not replaced: its "
            "key may be in use. Choose another --name or --out, or move it away first\n"
        )
        return 1
    except OSError as error:
        sys.stderr.write(f"envhub-worker keygen: {error}\n")
        return 1
    print(f"secret key: {secret} (keep it)\npublic key: {key_text(pair.public)} ({public})")
    return 0


def _parser(*, remote: bool) -> argparse.ArgumentParser:
    """``remote``: with the commands that take long to import."""
    parser = argparse.ArgumentParser(
        prog="envhub-worker", description="Executes environments from the Hub under confinement."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    serve = commands.add_parser("serve", help="serve one client on an ipc:// endpoint")
    serve.add_argument("--endpoint", required=True)
    serve.add_argument("--runtime-dir", type=Path, required=True)
    serve.add_argument("--readable-root", action="append", default=[])
    serve.add_argument("--ready-fd", type=int)
    serve.add_argument("--client-pidfd", type=int)
    serve.add_argument("--fd-path", type=Path)
    serve.add_argument("--until-eof", action="store_true")
    serve.add_argument("--announce", action="store_true")
    serve.add_argument("--ahead", action="store_true")
    serve.add_argument("--python", default="")
    serve.add_argument("--packages", default="")
    serve.set_defaults(run=_serve)
    if remote:
        _add_remote(commands)
    health = commands.add_parser("health", help="whether a server of this container answers")
    health.add_argument("--port", type=int, default=5555)
    health.add_argument("--state-dir", type=Path, help="as for listen")
    health.set_defaults(run=_health)
    return parser


def _add_remote(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    from envhub_worker.cli import drain, listen, status

    listening = commands.add_parser("listen", help="serve clients on other hosts, with keys")
    listen.add_arguments(listening)
    listening.set_defaults(run=_listen)
    asking = commands.add_parser("status", help="who uses a listening server")
    status.add_arguments(asking)
    asking.set_defaults(run=_status)
    draining = commands.add_parser("drain", help="end the server that listens here, gently")
    drain.add_arguments(draining)
    draining.set_defaults(run=_drain)
    keygen = commands.add_parser("keygen", help="make a CURVE key pair")
    keygen.add_argument(
        "--out", type=Path, default=Path(), metavar="DIR", help="where both lie (default: here)"
    )
    keygen.add_argument("--name", default="client", help="of NAME.key (secret) and NAME.pub")
    keygen.set_defaults(run=_keygen)


if __name__ == "__main__":
    if not (sys.flags.isolated or getattr(sys.flags, "safe_path", False)):
        sys.exit(
            "envhub-worker: not run, since python -m looks for modules in the current folder "
            f"first. Use: envhub-worker, or: {sys.executable} -I -m envhub_worker"
        )
    sys.exit(main())
