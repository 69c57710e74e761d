"""Where a user's brain can be opened: found, drawn, written as a job's lines."""
