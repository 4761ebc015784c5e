"""Strapdown navigation: Earth, base motion, sensors, mechanisation and error models."""
