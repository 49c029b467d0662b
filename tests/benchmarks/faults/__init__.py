"""What kills, freezes and outages cost."""
