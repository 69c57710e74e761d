"""Scoring: from a recording and methods to scores and a report."""
