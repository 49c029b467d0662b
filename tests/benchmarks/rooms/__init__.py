"""A textured MuJoCo scene of several rooms, as a foreign simulator behind the Gymnasium adapter."""
