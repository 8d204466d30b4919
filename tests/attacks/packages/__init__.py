"""Packages, sources and checkouts: what runs when they are chosen, built, installed or read."""
