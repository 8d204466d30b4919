"""A project with a ``src`` layout that nobody has installed."""

from garden import make_env

__all__ = ["make_env"]
