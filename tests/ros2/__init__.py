"""A ROS 2 robot that is none, and the body that drives it."""
