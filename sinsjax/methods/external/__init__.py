"""Programs outside sinsjax, whose stored results are compared with those of its methods."""
