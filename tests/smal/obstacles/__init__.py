"""Tests: the robot goes round what stands in its way."""
