"""``envhub check`` of whole repositories."""
