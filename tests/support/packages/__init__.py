"""Packages, their indexes and sources, made here, and folders of installed ones."""
