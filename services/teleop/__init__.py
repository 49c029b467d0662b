"""Driving by keyboard: ``keys`` reads what is pressed, ``terminal`` draws, ``session`` has an operator drive."""
