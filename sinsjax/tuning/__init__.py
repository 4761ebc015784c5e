"""Tuning of a study: searching its variables on some draws and evaluating the best on others.

`objective` is the quantity to minimise, `search` evaluates points of a grid or a sequence,
`descent` follows the gradient, `history` records the evaluations, `run_tuning` runs all that a
study's [tune] specifies, and `results` reads a complete tuning.
"""
