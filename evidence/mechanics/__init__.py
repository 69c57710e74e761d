"""Mechanical conditions (membrane, pulse, slip) that a force estimator must have been fitted on."""
