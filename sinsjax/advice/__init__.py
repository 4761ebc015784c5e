"""Advice for an inertial measurement unit, from its data sheet, without a Monte Carlo run."""
