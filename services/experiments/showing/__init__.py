"""What a model has learned, for people: `smal model show`."""
