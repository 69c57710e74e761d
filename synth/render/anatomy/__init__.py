"""The exposed cortex: relief, vessels, texture and the rim around the opening."""
