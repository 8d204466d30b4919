"""Exit codes, and the report of an error to the user: a paragraph on stderr, no traceback."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import traceback
from collections.abc import Iterator
from enum import IntEnum

import typer

from envhub_sandbox.cli.shared.console import print_json_error, safe_text, say
from envhub_worker.protocol.errors import EnvHubError
from envhub_worker.protocol.text import quoted

_TAIL_LINES = 10


class Exit(IntEnum):
    """The exit codes of a command and their meanings; ``docs/cli.md`` has the same table."""

    meaning: str

    def __new__(cls, code: int, meaning: str) -> Exit:
        """Make a code with its meaning."""
        member = int.__new__(cls, code)
        member._value_, member.meaning = code, meaning
        return member

    OK = 0, "done"
    ENVIRONMENT = 1, "the environment raised, or broke the rules"
    USAGE = 2, "wrong usage: an option, reference, policy or limit"
    SNAPSHOT = 3, "the files could not be downloaded, or differ from the commit"
    LOAD = 4, "the repository did not load, or a package is missing"
    WORKER = 5, "the worker died, timed out, or its server is full"
    SANDBOX = 6, "this host cannot enforce the policy"
    DIFFERENT = 7, "something differs: from the lock, between commits, or from a crash"
    SURVIVED = 8, "a replay without the crash"
    UNASKED = 9, "a container engine did not answer"
    UNJUDGED = 10, "no failure, but not all was judged"
    BUG = 70, "a bug in envhub"
    INTERRUPTED = 130, "interrupted"
    PIPE = 141, "broken pipe"
    TERMINATED = 143, "terminated"


EXIT_CODES = f"Exit codes: {'; '.join(f'{int(code)} {code.meaning}' for code in Exit)}."


class UsageError(EnvHubError):
    """The command's arguments are invalid; the text says what to write instead."""


class ForeignError(EnvHubError):
    """The repository's code, run in this process, raised the exception in ``__cause__``."""


def code_for(error: BaseException) -> Exit:
    """Return the exit code for an error."""
    if isinstance(error, KeyboardInterrupt):
        return Exit.INTERRUPTED
    if not isinstance(error, EnvHubError):
        return Exit.USAGE if _is_full(error) else Exit.BUG
    # imported here: only a failure pays for multiprocessing
    from envhub_sandbox import errors

    codes = {
        Exit.DIFFERENT: (errors.LockDriftError,),  # before LockError, its base class
        Exit.USAGE: (
            *(UsageError, errors.VideoError, errors.HubReferenceError, errors.PolicyError),
            *(errors.BundleError, errors.LockError),
        ),
        Exit.SNAPSHOT: (errors.SnapshotError,),
        Exit.LOAD: (errors.LoadError, errors.DependencyError),
        Exit.WORKER: (errors.WorkerError, errors.ProtocolError),
        Exit.SANDBOX: (errors.SandboxUnavailableError,),
    }
    return next(
        (code for code, kinds in codes.items() if isinstance(error, kinds)), Exit.ENVIRONMENT
    )


def describe(error: BaseException) -> str:
    """Describe an error for a terminal: escaped, without traceback, with the end of the output."""
    if _is_full(error):
        file = getattr(error, "filename", None) or "what is printed"
        return safe_text(f"no space is left for {file}; free some, and try again")
    if not isinstance(error, EnvHubError):
        return safe_text(f"a bug in envhub: {type(error).__name__}: {error}")
    text = str(error)
    tail = getattr(error, "log_tail", "")
    before, quote, after = text.rpartition(quoted(tail)) if tail else (text, "", "")
    if quote:
        kept = tail.rstrip().splitlines()[-_TAIL_LINES:]
        text = before + quoted("\n".join(kept)) + after
    return safe_text(text)


def _is_full(error: BaseException) -> bool:
    """Whether an error says that a disk, or the user's quota on it, is full."""
    full = (errno.ENOSPC, errno.EDQUOT)
    return isinstance(error, OSError) and error.errno in full and not isinstance(error, EnvHubError)


@contextlib.contextmanager
def reported(*, debug: bool) -> Iterator[None]:
    """Turn an error that ends a command into a message on stderr and an exit code."""
    try:
        yield
        sys.stdout.flush()
    except (typer.Exit, SystemExit):
        raise
    except KeyboardInterrupt:
        with _ignoring_full_or_closed_output():
            say("Interrupted.")
            print_json_error("KeyboardInterrupt", "interrupted", Exit.INTERRUPTED)
        raise typer.Exit(Exit.INTERRUPTED) from None
    except Exception as error:
        # a repository's own broken pipe is an EnvHubError, not the end of our output
        if isinstance(error, BrokenPipeError) and not isinstance(error, EnvHubError):
            _discard_output()
            raise typer.Exit(Exit.PIPE) from None
        with _ignoring_full_or_closed_output():
            _explain(error, debug)
            print_json_error(type(error).__name__, describe(error), code_for(error))
        raise typer.Exit(code_for(error)) from None


@contextlib.contextmanager
def _ignoring_full_or_closed_output() -> Iterator[None]:
    """Ignore errors of writing a message to a closed pipe or a full disk: keep the exit code."""
    with contextlib.suppress(OSError):
        yield
    _discard_output()


def _explain(error: Exception, debug: bool) -> None:
    both = (error, error.__cause__)
    remotes = [text for source in both if (text := getattr(source, "traceback", ""))]
    if debug:
        say(safe_text("".join(traceback.format_exception(error)), limit=200_000))
        for remote in remotes:
            say(f"In the worker:\n{safe_text(remote, limit=200_000)}")
    say(f"Error: {describe(error)}", style="red")
    if not debug and (remotes or not isinstance(error, EnvHubError)):
        say("(--debug shows the traceback)")


def _discard_output() -> None:
    """Discard buffered output, which would fail again when the interpreter ends."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        except ValueError:
            pass  # the stream is closed
