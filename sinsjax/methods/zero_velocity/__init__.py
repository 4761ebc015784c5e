"""Zero-velocity alignment with a Kalman filter, [P1]."""
