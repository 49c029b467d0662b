"""Report of a model: `smal model show`."""
