"""The motion that a film of somebody's camera shows: flow, heart and breath, what is lost."""
