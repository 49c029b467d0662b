"""What the services hold while the robot drives for an hour."""
