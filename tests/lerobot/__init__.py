"""LeRobot itself, in processes of its own: ``python -m tests.lerobot`` has all that is tested."""
