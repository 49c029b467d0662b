"""From the capture of a frame to its command."""
