"""The Zenoh router as a process of ours, where no zenohd is at hand."""
