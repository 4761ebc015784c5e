"""Level of a base at rest from its accelerometers alone."""
