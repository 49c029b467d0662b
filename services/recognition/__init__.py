"""Observations and odometry in, where the robot is in what was taught out."""
