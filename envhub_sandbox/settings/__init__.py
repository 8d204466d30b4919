"""What a caller may set: every option of ``make_env``, and what a policy permits."""
