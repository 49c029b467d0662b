"""What a world looks like: meshes, textures, sky and light, and the camera that renders them with SAPIEN."""
