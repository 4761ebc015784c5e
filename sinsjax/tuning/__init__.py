"""Tuning of a study: search of its variables on some draws, evaluation of the best on others.

It takes a study with [tune], and searches by a grid, Sobol points or gradient descents, always with
the reset schedule by the law among the points. It gives a directory with the tuned study, which
`results` reads: the best points, and their scores on draws that did not tune.
"""
