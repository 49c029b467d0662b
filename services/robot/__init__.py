"""Actuation of any wheeled robot: the choice of the obeyed command, and the episodes.

The process is a body's: `services/simulator` and `services/ros2` serve one with `services.robot.service.serve_robot`.
"""
