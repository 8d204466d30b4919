"""The steps of ``make_env``: from its arguments to vector environments."""
