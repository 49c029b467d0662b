"""Import of foreign recordings: one module per format, then resampling, actions and recordings."""
