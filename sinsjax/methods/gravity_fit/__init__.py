"""Alignment by the turn of gravity in inertial space, with sensor biases as unknowns."""
