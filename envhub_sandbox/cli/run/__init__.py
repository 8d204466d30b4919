"""``envhub run``: episodes, how they are played, filmed and counted."""
