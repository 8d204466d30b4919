"""What becomes of an environment when its processes die: it fails, or they are brought back."""
