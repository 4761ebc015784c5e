"""Compass alignment by levelling and azimuth loops, [P2]."""
