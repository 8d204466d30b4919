"""The operator's view of a server: a log and figures."""
