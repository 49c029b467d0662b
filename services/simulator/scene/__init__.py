"""Appearance of a world: meshes, textures, sky, light, and cameras rendered by SAPIEN."""
