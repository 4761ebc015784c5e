"""Alignment methods: how a navigator finds its attitude, each a few pure functions of one run.

They take the keys of a study, an initial solution and compensated samples. They give the attitude
after each sample, and where they have them its covariance, bias floor and result columns.
"""
