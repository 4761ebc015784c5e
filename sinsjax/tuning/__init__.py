"""Tuning of a study: search of its variables on some draws, evaluation of the best on others.

`run_tuning` runs all that a study's [tune] specifies, into a directory. `search` scores points, of
a grid or by Sobol; `gradient` descends. `law_point` is the reset schedule by the law, a point of
every search. `objective` is the quantity to minimise, `history` stores the evaluations, and
`results` reads a complete tuning run.
"""
