"""What every service is made of: the bus, the process around it, its settings, health and metrics."""
