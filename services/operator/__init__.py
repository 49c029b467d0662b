"""What a person who drives tells the robot, whatever they sit at: a terminal (``teleop``) or a page (``console``).

``commands`` turns keys into commands, ``operator`` joins them to a bus, and ``report`` is what was last heard of the
robot.
"""
