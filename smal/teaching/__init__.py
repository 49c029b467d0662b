"""Teaching: from drives to the map, as in `smal learn`. Driving imports nothing from it."""
