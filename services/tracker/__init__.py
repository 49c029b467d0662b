"""Overhead image in, the robot's true pose out."""
