"""Closed-loop experiments in one process: the simulator, the method and its peers, without a bus between them."""
