"""From a zygote to a jail: fork, hand over, start."""
