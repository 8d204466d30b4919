"""A repository's packages: what it declares, resolved and installed without running any of it."""
