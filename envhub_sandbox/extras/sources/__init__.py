"""Fetches snapshots from git and indexes, and assets; reads checkouts and Python source as data."""
