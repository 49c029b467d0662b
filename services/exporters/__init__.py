"""Export recordings: a bag of ROS 2, a LeRobotDataset, a folder of images with a table."""
