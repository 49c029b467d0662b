"""Operator's side of the robot, for the terminal (``teleop``) and the page (``console``)."""
