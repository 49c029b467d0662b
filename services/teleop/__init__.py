"""Driving by keyboard: ``keys`` parses input, ``terminal`` draws, ``session`` connects an operator."""
