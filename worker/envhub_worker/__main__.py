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
  (``protocol/confinement.py``).
- ``--ahead`` starts a zygote at once, in the interpreter ``X`` and for the packages ``Y``, by
  default this interpreter with its own, for the first jail.
- environment: nothing is read from it but what Python itself needs.
- exit code: 0 after a stop, 2 for wrong arguments.

``envhub-worker listen`` serves clients on other hosts. It keeps keys and snapshots in
``--state-dir D``, by default below ``$XDG_STATE_HOME``. Its options, and the commands about such a
server, are in the help.

A program that starts such a server for one client of its own adds ``--only-client KEY``, the public
key of that client: the server's own pair is made for this one life and is on no disk, there is no
note for the other commands. Such a server ends with that program by ``--client-pidfd N``, where
what lies in ``D`` is shared with other such servers, or by ``--until-eof``. It says its public key
once the endpoint is bound: after the endpoint, in the one line that ``--ready-fd N`` gets, or in
that of ``--announce``.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence

from envhub_worker.find_extra import find_extra
from envhub_worker.server import serve


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command: see the head of this file."""
    replace_missing_streams()  # before anything of ours is opened
    # The jails of a root server run as another user, who must be able to read our files; private
    # files set their own mode.
    os.umask(0o022)
    argv = sys.argv[1:] if argv is None else argv
    parser, names = _parser(all_commands=argv[:1] != ["serve"])
    if argv and argv[0] not in names:
        import difflib

        near = difflib.get_close_matches(argv[0], names, 1)
        if near:
            parser.error(f"there is no command {argv[0]!r}; did you mean {near[0]!r}?")
    arguments = parser.parse_args(argv)
    run: Callable[[argparse.Namespace], int] = arguments.run
    return run(arguments)


def replace_missing_streams() -> None:
    """Open the descriptors 0, 1 and 2 if they are closed, and set ``sys.stdout`` and the like.

    Otherwise our own files would get these numbers: a library's output, such as libzmq's before an
    abort, would go into a socket or a lock, and a zygote would inherit them as its streams.
    """
    while (null := os.open(os.devnull, os.O_RDWR)) < 3:  # the lowest that is free
        os.set_inheritable(null, True)
    os.close(null)
    sys.stdin = sys.stdin or open(os.devnull)  # noqa: SIM115
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115


def _parser(*, all_commands: bool) -> tuple[argparse.ArgumentParser, list[str]]:
    """Returns the parser and its commands; ``all_commands``: with those that import slowly."""
    parser = argparse.ArgumentParser(
        prog="envhub-worker",
        description="Runs environments from the Hugging Face Hub in confined processes.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    serving = commands.add_parser("serve", help="serve one client on an ipc:// endpoint")
    serve.add_arguments(serving)
    serving.set_defaults(run=serve.run)
    if all_commands:
        _add_others(commands)
    return parser, list(commands.choices)


def _add_others(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    for name, what in (
        ("listen", "serve clients on other hosts, with keys"),
        ("status", "print sessions, connections and jails of a server"),
        ("drain", "end a server after its open jails are closed"),
        ("keygen", "make a CURVE key pair"),
        ("health", "test whether the server on this machine answers"),
    ):
        command = find_extra(f"access.commands.{name}")
        if command is not None:
            parser = commands.add_parser(name, help=what)
            command.add_arguments(parser)
            parser.set_defaults(run=command.run)


if __name__ == "__main__":
    if not (sys.flags.isolated or getattr(sys.flags, "safe_path", False)):
        sys.exit(
            "envhub-worker did not start: python -m imports modules from the current folder "
            f"first, which may be untrusted. Use: envhub-worker, or: {sys.executable} -I -m "
            "envhub_worker"
        )
    sys.exit(main())
