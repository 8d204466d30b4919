"""``python -I -m envhub_sandbox`` is the command line ``envhub``.

Without ``-I`` (or ``-P``) the current folder comes first on ``sys.path``, and that may be a
stranger's repository: a ``typer.py`` in it would be executed here, unconfined. So nothing more is
imported then.
"""

import sys

if __name__ == "__main__":
    if not (sys.flags.isolated or getattr(sys.flags, "safe_path", False)):
        sys.stderr.write(
            "envhub did not start: python -m imports modules from the current folder first, which "
            f"may be untrusted. Use: envhub, or: {sys.executable} -I -m envhub_sandbox\n"
        )
        sys.exit(2)

    from envhub_sandbox.cli import main

    main()
