"""Networks from displacement to force."""
