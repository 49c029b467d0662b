"""Simulated worlds and robots, and the service that publishes them."""
