"""Mechanics of other programs: their files, and the transfer of motion and load to the scene's surface."""
