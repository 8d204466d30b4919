"""Judges a repository before it is trusted: the checks of ``envhub check`` and their reports."""
