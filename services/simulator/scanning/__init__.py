"""Import of a scan of a real place: its meshes, and the floor that a robot can drive on."""
