"""Starts jails: a zygote forks an init, and init forks confined runners."""
