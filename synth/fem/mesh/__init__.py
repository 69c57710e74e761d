"""The volume mesh: tetrahedra of a block or of a brain, their shape functions and supports."""
