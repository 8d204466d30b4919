"""Manages the jails of a server: opens them, passes requests, watches and ends them."""
