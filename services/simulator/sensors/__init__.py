"""What the robot senses: its camera, its wheels, its tilt."""
