"""Recordings as other software reads them: a bag of ROS 2, a LeRobotDataset, a folder of images with a table."""
