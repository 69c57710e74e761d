"""Running a job: workers, slots, clusters, progress."""
