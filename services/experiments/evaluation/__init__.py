"""Closed-loop experiments in one process: simulator, method and baselines, without a bus."""
