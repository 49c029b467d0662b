"""What people read of an evaluation; no result depends on anything in here."""
