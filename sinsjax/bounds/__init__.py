"""The least heading error that any method can reach, and how to turn the base for it."""
