"""Inside of `smal.paper.state_matching`: a working set of template frames, Newton's method on it, and the certificate.

From the outside in: `working_set` grows the set; `newton` solves Eq. 7 on it; `certificate` extends the dual point of
that solution to all sequences, with what `products` multiplies. `streaming` matches the last frames of a stream.
"""
