"""Commands of ``envhub-worker``, one file each; ``serve`` and ``keygen`` are in ``__main__``."""
