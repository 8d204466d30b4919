"""Records what a jail was denied, and which files and processes its calls name."""
