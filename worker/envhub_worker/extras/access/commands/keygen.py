"""``envhub-worker keygen``: a CURVE key pair, in two files."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from envhub_worker.extras.access import keys
from envhub_worker.protocol.keys import key_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``keygen``."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="folder for both files (default: here)",
    )
    parser.add_argument(
        "--name", default="client", help="writes NAME.key (secret) and NAME.pub (default: client)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Make a key pair, and say its public key."""
    pair = keys.generate()
    try:
        secret, public = keys.save(pair, arguments.out, arguments.name)
    except FileExistsError as error:
        sys.stderr.write(
            f"envhub-worker keygen: {error.filename} exists and is not replaced: its key may be in "
            "use. Choose another --name or --out, or move it away first\n"
        )
        return 1
    except OSError as error:
        sys.stderr.write(f"envhub-worker keygen: {error}\n")
        return 1
    print(f"secret key: {secret} (keep it)\npublic key: {key_text(pair.public)} ({public})")
    return 0
