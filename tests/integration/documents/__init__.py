"""What the documents show is executed, and does what they say."""
