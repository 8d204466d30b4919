"""The worker in containers of a real engine."""
