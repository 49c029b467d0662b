"""Round what stands in the way, by a depth camera: what is free about the robot, and where to go."""
