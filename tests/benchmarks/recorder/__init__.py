"""What the recorder holds while one drive goes on for hours."""
