"""What envhub check says of what is known to be hostile, honest or faulty."""
