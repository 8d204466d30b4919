"""Restarts dead workers while an episode goes on: ``restart="transparent"``."""
