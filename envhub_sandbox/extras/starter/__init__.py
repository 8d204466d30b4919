"""``envhub init``: the files of a new environment's repository."""
