"""The commands of ``envhub`` as a user types them."""
