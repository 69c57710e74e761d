"""The networks of the package: how each of them is made, from nothing. In the checkout only."""
