"""Tests: the map is made of drives."""
