"""This project's own evidence: what its defaults and claims are measured by. In the checkout only."""
