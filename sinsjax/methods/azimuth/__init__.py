"""Zero-velocity alignment with a nonlinear model of a large azimuth: extended and unscented."""
