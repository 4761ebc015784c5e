"""The engine: one run as equations, many runs as one compiled program.

It takes a checked study, and the record if it reads one. It gives the outcome of each run, and
curves if they are wanted, in SI units and in an order that no machine changes.
"""
