"""From drives to the map: what `smal learn` does. A robot that drives needs none of it."""
