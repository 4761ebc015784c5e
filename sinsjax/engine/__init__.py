"""The engine: one run as equations, many runs as one compiled program."""
