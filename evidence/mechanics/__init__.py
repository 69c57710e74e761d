"""What of a living brain's mechanics a force estimator must have been fitted on, and what that costs."""
