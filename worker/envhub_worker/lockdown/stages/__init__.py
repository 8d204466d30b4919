"""The stages of lockdown in order: zygote, jail (its init), runner with its self-test."""
