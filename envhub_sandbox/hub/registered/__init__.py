"""Environments that a package registers with Gymnasium, as repositories of one file of ours."""
