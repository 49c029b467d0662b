"""Observations in, the learned state that the robot is in out (Eq. 9)."""
