"""Tests of the paper's scheme."""
