"""``envhub check``, of one repository or a list of them, and ``envhub diff``."""
