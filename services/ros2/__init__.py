"""A body for the robot: a real ROS 2 base, reached over Zenoh without ROS on this machine."""
