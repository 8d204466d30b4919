"""What was written for no sandbox: how much of it runs in ours, by its reference alone."""
