"""What a frame of each kind of scene costs."""
