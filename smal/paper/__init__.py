"""Sequence-based Multimodal Apprenticeship Learning (Han, Yang, Zhang & Zhang, ICRA 2017).

Read in the order of the paper: `objective` (Eq. 7), `state_matching` (Algorithm 2), `novelty` (Eq. 8),
`state_space` (Algorithm 1), `action_space` (Algorithm 3), `transitions` (Algorithm 4), `reward`, `policy` (Eq. 13);
`learning` puts them together to a `model`, `recognition` (Eq. 7) and `execution` drive by it, `robot` is the two
together. How `state_matching` solves Eq. 7 is in `working_set`, `newton` and `duality_gap`. Each file says where it
departs from the paper, and why.

sequence
    l successive frames; template sequences are those that states were made of.
state
    What a sequence shows; state j is the columns j l to j l + l - 1 of X, its template, a block of rows of W.
phase
    The frame of a state's template at which the last frame of a query is.
action
    l atoms, one from each frame to the next, beginning with the last frame of a sequence.
recovery
    A short demonstrated drive from beside the way back onto it.
polar
    Of the penalties in Eq. 7: how far a point is outside of the dual problem (`duality_gap`).
"""
