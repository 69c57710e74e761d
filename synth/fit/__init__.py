"""Fitting a family of the job to one photograph, by the statistics of pictures."""
