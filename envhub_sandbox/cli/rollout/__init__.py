"""Episodes played and filmed, for ``envhub run``."""
