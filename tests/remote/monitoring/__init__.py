"""What a server says of itself: log, figures, health, and what ``doctor`` makes of them."""
