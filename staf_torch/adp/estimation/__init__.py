"""Control what is measured with noise: outputs, Kalman filters."""
