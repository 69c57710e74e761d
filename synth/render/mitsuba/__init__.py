"""The Mitsuba backend: stage, lens, direct light and its filter."""
