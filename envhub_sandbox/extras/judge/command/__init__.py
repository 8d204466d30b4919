"""``envhub check``: one repository, or a list of them."""
