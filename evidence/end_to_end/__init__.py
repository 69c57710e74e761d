"""Whole pipelines: error of the force against cost."""
