"""Report of an evaluation; results do not depend on it."""
