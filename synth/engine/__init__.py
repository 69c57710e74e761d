"""Execution of a job: workers, slots, clusters, progress."""
