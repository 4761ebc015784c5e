"""What Kalman filters share: stages and closed loop, sections of a study, numbers, columns."""
