"""Motion of tissue in recorded videos: flow, camera motion, heart and breath, faults of the pictures."""
