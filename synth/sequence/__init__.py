"""One sequence, from (job, index) to a sealed store."""
