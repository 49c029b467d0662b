"""Sequence-based Multimodal Apprenticeship Learning (Han, Yang, Zhang & Zhang, ICRA 2017).

Read in the order of the paper: `objective` (Eq. 7), `state_matching` (Algorithm 2), `novelty` (Eq. 8),
`state_space` (Algorithm 1), `action_space` (Algorithm 3), `transitions` (Algorithm 4), `reward`, `policy` (Eq. 13).
`learning` combines them to a `model`. `recognition` (Eq. 7) and `execution` drive by it, and `robot` combines the two.
`working_set`, `newton` and `duality_gap` solve Eq. 7 for `state_matching`. Each file gives its departures from the
paper, with reasons.

sequence
    l successive frames; states are made of template sequences.
state
    Content of a sequence; state j is the columns j l to j l + l - 1 of X, its template, a block of rows of W.
phase
    Frame of a state's template that matches the last frame of a query.
action
    l atoms, one from each frame to the next, beginning with the last frame of a sequence.
recovery
    A short demonstrated drive from beside the way back onto it.
polar
    For the penalties in Eq. 7: distance of a point outside of the dual problem (`duality_gap`).
"""
