"""A base without ROS: any camera of OpenCV, and lines of text over a serial port, TCP or UDP."""
