"""The program that has a jail build a wheel; ``extras.packages.builds`` starts it."""
