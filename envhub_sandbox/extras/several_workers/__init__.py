"""One environment over several workers, each with a jail of its own; ``send`` and ``recv``."""
