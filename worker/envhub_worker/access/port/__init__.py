"""The TCP port: keys are proved there, and connections bounded."""
