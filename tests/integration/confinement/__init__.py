"""What a jail denies, limits and still permits; the same source without a jail is the control."""
