"""The simulated world: terrain, robot, camera, and the service that puts them on the bus."""
