"""What more sequences buy: learning curves."""
