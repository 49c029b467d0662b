"""Tests: the robot sees what it was sent to find."""
