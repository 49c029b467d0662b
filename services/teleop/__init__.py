"""Driving by keyboard from a terminal, over the same topic as every other driver.

``keys`` turns bytes of a terminal into keys, ``terminal`` is the screen, and ``session`` joins them to an operator.
"""
