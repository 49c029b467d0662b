"""A fake ROS 2 robot, and the body that drives it."""
