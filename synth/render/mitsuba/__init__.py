"""All that knows Mitsuba: stage and lens."""
