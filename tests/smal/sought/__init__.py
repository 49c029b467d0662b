"""Tests of target detection."""
