"""Servers on other hosts: keys, quotas, uploads, and networks that fail."""
