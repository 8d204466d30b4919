"""Plays environments, counts their episodes, and films them: for ``envhub run`` and ``check``."""
