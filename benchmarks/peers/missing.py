"""The error for what is not there to be measured."""


class Missing(Exception):
    """A peer, or one of its options, is not installed here."""
