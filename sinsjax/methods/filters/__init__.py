"""The parts that Kalman filters of a measured zero velocity share.

They take the kinds of a filter's states, its stages (`loop.Filter`) and the keys of [filter] and
[resets]. They give a `Method` that feeds its estimate back and resets P, by schedule or trigger.
"""
