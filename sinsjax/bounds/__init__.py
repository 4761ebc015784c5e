"""The least heading error that any method can reach, and how to turn the base for it.

It takes the motion of the base, the place and the errors of the sensors as standard deviations. It
gives 1 sigma of the heading over time, its parts by source of error, and motions to choose from.
"""
