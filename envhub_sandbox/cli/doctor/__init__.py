"""``envhub doctor``: this host, and a server on another."""
