"""Read what others made, and run their programs: one sentence for what cannot be used, and bounds on what it takes."""
