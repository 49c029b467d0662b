"""What the robot was sent to find: learned from where drives end, and looked for in a run."""
