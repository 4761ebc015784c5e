"""Strapdown navigation: the Earth, a base that sways, surges and turns, its sensors, mechanisation.

It takes constants of the Earth, the motion of the base and the errors of the sensors, in SI units.
It gives true attitudes, measured increments, navigation solutions and the linear model of their
errors.
"""
