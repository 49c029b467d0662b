"""Ground truth by a camera above: the tag on the robot, and its pose (paper, section V-B)."""
