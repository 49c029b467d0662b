"""Obstacles: the occupancy grid around the robot from a depth camera, and the way around obstacles."""
