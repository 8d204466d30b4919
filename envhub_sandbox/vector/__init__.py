"""The Gymnasium face: vector environments, suites, and what a manifest makes of them."""
