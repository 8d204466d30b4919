"""Builds wheels for packages that have none: reads sources as data, builds them in a jail."""
