"""What a person who drives tells the robot, whatever they sit at: a terminal (``teleop``) or a page (``console``).

``hold`` is the key that is held, ``commands`` turns it into commands (both pure), ``operator`` joins them to a bus, and
``report`` is what was last heard of the robot.
"""
