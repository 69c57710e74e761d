"""What of a living brain's mechanics a force reader must have been fitted on, and what that costs."""
