"""Driving by keyboard from a terminal, over the same topic as every other driver.

``keys`` turns bytes of a terminal into keys held, ``service`` turns keys into commands (both pure), ``terminal`` is
the screen, and ``session`` joins them to the bus.
"""
