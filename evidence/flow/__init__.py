"""Flow measured: error against time, and where it breaks."""
