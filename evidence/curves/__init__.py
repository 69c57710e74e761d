"""Learning curves: error of the force against the number of training sequences."""
