"""From recordings to what `smal learn` learns from."""
