"""``envhub lock``, and ``envhub inspect --download``."""
