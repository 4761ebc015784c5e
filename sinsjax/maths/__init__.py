"""Mathematics of the alignment: 3-vectors, attitudes and counter-based random numbers."""
