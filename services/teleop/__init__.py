"""Driving by keyboard: ``keys`` parses, ``terminal`` draws, ``session`` connects an operator."""
