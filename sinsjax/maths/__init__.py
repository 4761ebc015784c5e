"""Mathematics of the alignment: 3-vectors, attitudes and counter-based random numbers.

It takes the scalars of one run, 3-vectors and quaternions made of them, or a seed and counters. It
gives the same, written out so that they become vectors over runs when mapped.
"""
