"""The job: everything one dataset depends on, its schema, reading, writing and identity."""
