"""Tests of place recognition."""
