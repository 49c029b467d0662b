"""Body of a real ROS 2 base, connected over Zenoh without ROS on this machine."""
