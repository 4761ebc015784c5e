"""Strapdown navigation: Earth, base motion, sensors, mechanisation, error models."""
