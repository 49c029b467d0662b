"""Localisation: observations and odometry in, the robot's place along the taught ways out."""
