"""How a repository is played, for a verdict and by ``envhub run``, and what is seen meanwhile."""
