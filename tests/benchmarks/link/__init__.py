"""What a bad link between robot and perception costs."""
