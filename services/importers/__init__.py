"""Other people's recordings become ours: one file a format, then ticks, atoms, and an ordinary recording."""
