"""Many places for the workers of one environment: which there are, and which worker goes where."""
