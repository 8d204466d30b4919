"""How a repository is played, and what is seen from outside meanwhile."""
