"""Import foreign recordings: one file a format, then ticks, atoms, and an ordinary recording."""
