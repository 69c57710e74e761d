"""All that knows Mitsuba: stage, lens and volume."""
