"""Reached by a relative import."""

from dataclasses import dataclass


@dataclass
class Bolt:
    """A bolt."""

    diameter: int
