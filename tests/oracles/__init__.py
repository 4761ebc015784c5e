"""The same computations written naively, to hold the engine against."""
