"""Tests of a base without ROS."""
