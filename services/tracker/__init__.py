"""Ground truth: overhead images in, the robot's pose out."""
