"""What a person who drives tells the robot, whatever they sit at: a terminal (``teleop``) or a page (``console``)."""
