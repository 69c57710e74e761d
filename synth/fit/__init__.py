"""The camera of one photograph, measured, and the family of the job that is nearest."""
