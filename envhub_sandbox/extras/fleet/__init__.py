"""Several places for the workers of one environment, and the choice of a place for each worker."""
