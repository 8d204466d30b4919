"""Who may come in, and what a client may ask and use up."""
