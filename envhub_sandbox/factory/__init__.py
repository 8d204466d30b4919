"""What ``make_env`` does with its arguments, step by step."""
