"""How it looks: families of colour and wetness, lamps, reflections."""
