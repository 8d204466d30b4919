"""The settings of a caller: every option of ``make_env``, and policies."""
