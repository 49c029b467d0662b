"""What a message costs beside plain Zenoh."""
