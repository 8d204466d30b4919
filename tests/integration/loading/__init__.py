"""From a repository to an environment, and what is said where that fails."""
