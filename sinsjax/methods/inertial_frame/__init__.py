"""Alignment by the turn of gravity in inertial space: from nothing but the sensors."""
