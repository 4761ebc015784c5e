"""Linear covariance analysis of the true error: expected results without draws, and bounds."""
