"""``python -m envhub_sandbox`` is the command line ``envhub``."""

from envhub_sandbox.cli import main

if __name__ == "__main__":
    main()
