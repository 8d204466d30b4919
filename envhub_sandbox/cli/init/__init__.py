"""``envhub init``: the command, and the files that it writes."""
