"""Plays episodes, for ``envhub run`` and for checks."""
