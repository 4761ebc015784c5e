"""Mathematics of an alignment: 3-vectors, attitudes, and random numbers by counter."""
